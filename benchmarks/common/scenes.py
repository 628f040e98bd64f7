"""Synthetic inputs that benchmarks and tests share: discs on a sphere, and a sky."""

from __future__ import annotations

import numpy as np


def unit(v: np.ndarray) -> np.ndarray:
    """v / |v| by rows."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def facing(normal: np.ndarray) -> np.ndarray:
    """Quaternions (N, 4) that turn +z to unit normals (N, 3) the shortest way."""
    q = np.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0], 1 + normal[:, 2]], 1)
    return np.where(np.abs(q).max(axis=1, keepdims=True) > 1e-6, q, np.array([1.0, 0, 0, 0]))


def discs(
    count: int = 40, seed: int = 1, degree: int = 2, opacity: float = 1.5, sh: float = 0.12, glow: float = 0.1
) -> dict[str, np.ndarray]:
    """Overlapping discs on a unit sphere, normals outward with some noise, every attribute (N, …) raw.

    degree: of spherical harmonics; opacity: largest logit; sh, glow: deviations of radiance_sh, indirect_sh.
    """
    rng = np.random.default_rng(seed)
    normal = unit(rng.normal(size=(count, 3)))
    coefficients = 3 * (degree + 1) ** 2
    return {
        "position": normal,
        "rotation": facing(normal) + 0.1 * rng.normal(size=(count, 4)),
        "scale": np.log(rng.uniform(0.25, 0.5, (count, 2))),
        "opacity": rng.uniform(-1, opacity, (count, 1)),
        "radiance_sh": sh * rng.normal(size=(count, coefficients)),
        "albedo": rng.normal(size=(count, 3)),
        "metallic": rng.normal(size=(count, 1)),
        "roughness": rng.normal(size=(count, 1)),
        "indirect_sh": glow * rng.normal(size=(count, coefficients)) + 0.5 * (np.arange(coefficients) < 3),
    }


def asymmetric_sky(height: int) -> np.ndarray:
    """Radiance (h, 2h, 3) without symmetries, so smooth that lookups have no strong kinks between texels."""
    θ, φ = np.meshgrid(np.linspace(0, np.pi, height), np.arange(2 * height) * np.pi / height, indexing="ij")
    x, y, z = np.sin(θ) * np.sin(φ), np.cos(θ), np.sin(θ) * np.cos(φ)
    log = [0.8 * x - 0.3 * y + 0.5 * x * z, 0.6 * y + 0.4 * z - 0.5 * x * y, 0.7 * z - 0.2 * x + 0.6 * y * z]
    return np.exp(np.stack(log, -1))
