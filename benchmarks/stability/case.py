"""What a hard case is made of, and the plain scene from which most of them differ in one thing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.reference.camera import look_at
from mi_refgs.reference.splat import PinholeCamera

Array = np.ndarray
Raw = dict[str, Array]
WIDTH, HEIGHT = 24, 20


@dataclass(frozen=True)
class Case:
    """A scene, a camera, and how it is rendered; float32 numbers, so that every renderer gets the same."""

    name: str
    raw: Raw
    camera: PinholeCamera
    light: Array  # raw values (h, 2h, 3)
    at: str = "pixel"
    reflectance: str = "split_sum"
    diffuse: str = "sh"
    mesh: Callable[[], Mesh] | None = None  # made when it is needed
    surface: Any = None  # vertices and faces of the mesh, and offset of rays: what the oracle traces
    further: float = 0.0  # rays may start so much further off the surface: nothing is compared there
    pixels: int | None = None  # the oracle sees a random subset of this size; None: all
    offset: tuple[int, int] = (0, 0)  # of a crop window in its film
    quick: bool = True  # cheap enough for every test run
    near: float | None = None  # the camera's near plane, if the case is about it
    band: float = 1e-4  # relative width of the declared discontinuities, above what rounding does to α

    def rounded(self) -> Case:
        """With all numbers rounded to float32."""
        return replace(
            self,
            raw={name: np.asarray(x, np.float32) for name, x in self.raw.items()},
            light=np.asarray(self.light, np.float32),
        )


def sphere(count: int = 40, seed: int = 1, degree: int = 2) -> Raw:
    """Overlapping discs on a unit sphere, normals outward with some noise, every channel."""
    rng = np.random.default_rng(seed)
    normal = unit(rng.normal(size=(count, 3)))
    coefficients = 3 * (degree + 1) ** 2
    return {
        "position": normal,
        "rotation": facing(normal) + 0.1 * rng.normal(size=(count, 4)),
        "scale": np.log(rng.uniform(0.25, 0.5, (count, 2))),
        "opacity": rng.uniform(-1, 1.5, (count, 1)),
        "radiance_sh": 0.12 * rng.normal(size=(count, coefficients)),
        "albedo": rng.normal(size=(count, 3)),
        "metallic": rng.normal(size=(count, 1)),
        "roughness": rng.normal(size=(count, 1)),
        "indirect_sh": 0.1 * rng.normal(size=(count, coefficients)) + 0.5 * (np.arange(coefficients) < 3),
    }


def filled(count: int = 40, **values: float) -> Raw:
    """Channels of the sphere with one raw value everywhere."""
    return {name: np.full_like(sphere(count)[name], value) for name, value in values.items()}


def unit(v: Array) -> Array:
    """v / |v| by rows."""
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def facing(normal: Array) -> Array:
    """Quaternions (N, 4) that turn +z to unit normals (N, 3)."""
    q = np.stack([-normal[:, 1], normal[:, 0], 0 * normal[:, 0], 1 + normal[:, 2]], 1)
    return np.where(np.abs(q).max(axis=1, keepdims=True) > 1e-6, q, np.array([1.0, 0, 0, 0]))


def camera(
    origin: Any = (3.0, 1.0, 2.0),
    target: Any = (0.0, 0.0, 0.0),
    fov: float = 45.0,
    width: int = WIDTH,
    height: int = HEIGHT,
    near: float = 0.0,
) -> PinholeCamera:
    """A pinhole camera in Mitsuba's frame; `fov` in degrees across the width."""
    focal = 0.5 * width / np.tan(np.radians(fov) / 2)
    pose = look_at(np.asarray(origin, np.float64), np.asarray(target, np.float64))
    return PinholeCamera(width, height, -focal, -focal, width / 2, height / 2, pose, near)


def sky(height: int = 16, peak: float = 0.0) -> Array:
    """Raw values of a light without symmetries; one texel near the equator has the radiance `peak`."""
    θ, φ = np.meshgrid(np.linspace(0, np.pi, height), np.arange(2 * height) * np.pi / height, indexing="ij")
    x, y, z = np.sin(θ) * np.sin(φ), np.cos(θ), np.sin(θ) * np.cos(φ)
    log = [0.8 * x - 0.3 * y + 0.5 * x * z, 0.6 * y + 0.4 * z - 0.5 * x * y, 0.7 * z - 0.2 * x + 0.6 * y * z]
    radiance = np.exp(np.stack(log, -1))
    if peak:
        radiance[height // 2 - 1, height // 3] = peak
    return raw_light(radiance)


def raw_light(radiance: Array) -> Array:
    """Inverse of softplus, float64."""
    return radiance + np.log(-np.expm1(-radiance))


def plain(name: str, **changes: Any) -> Case:
    """The plain scene, with any field of `Case` replaced; `raw` may hold some of the channels only."""
    raw = sphere() | changes.pop("raw", {})
    return Case(name, raw, changes.pop("camera", camera()), changes.pop("light", sky()), **changes)
