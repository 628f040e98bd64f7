"""The float64 oracle with derivatives: `mi_refgs.reference.splat` as matrices (surfels, pixels).

Derivatives of the footprint are complex steps, exact to the last digit: the imaginary part of f(x + ih) is
h f'(x). Those of compositing follow from its sums.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference import splat as oracle
from mi_refgs.reference import surfel

Array = np.ndarray
STEP = 1e-40


@dataclass(frozen=True)
class Exact:
    """Maps (H·W, K + 2) — features, depth, alpha — and the derivatives of Σ weights · maps."""

    maps: Array
    gradients: dict[str, Array]  # as the raw channels, and "features" (N, K)
    shown: Array  # (N, H·W): whether a surfel contributes to a pixel


def differentiate(
    raw: dict[str, Array],
    features: Array,
    camera: oracle.PinholeCamera,
    weights: Array,
    order: Array | None = None,
) -> Exact:
    """Maps, and gradients for adjoints `weights` (K + 2, H·W) of them.

    `order` (N, H·W) replaces the oracle's: surfels from front to back.
    """
    x, y = (v.ravel() for v in np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5))
    surfels = surfel.camera_surfels(raw, camera)
    if order is None:
        order = surfel.order(surfels, camera).reshape(len(features), -1)
    culled = surfels["opacity"] == 0

    alpha, z = (values.real for values in footprint(raw, camera, x, y))
    alpha = np.where((alpha >= c.ALPHA_MIN) & (z > camera.near) & ~culled[:, None], alpha, 0)
    alpha, z = (np.take_along_axis(values, order, axis=0) for values in (alpha, z))
    after = np.cumprod(1 - alpha, axis=0)
    before = np.concatenate([np.ones((1, len(x))), after[:-1]])
    shown = (alpha > 0) & np.logical_and.accumulate(after >= c.TRANSMITTANCE_MIN, axis=0)
    weight = np.where(shown, before * alpha, 0)
    sorted_features = features[order]  # (surfels, pixels, K)
    maps = np.einsum("np,npk->pk", weight, sorted_features)
    maps = np.concatenate([maps, np.sum(weight * z, 0)[:, None], np.sum(weight, 0)[:, None]], axis=1)

    value = np.einsum("npk,kp->np", sorted_features, weights[:-2]) + weights[-2] * z + weights[-1]
    part = weight * value
    behind = np.cumsum(part[::-1], axis=0)[::-1] - part
    δalpha = np.where(shown, before * value - behind / (1 - alpha), 0)
    δalpha, δz, weight = (_unsort(v, order) for v in (δalpha, weight * weights[-2], weight))
    gradients = {"features": weight @ weights[:-2].T}
    for name in ("position", "rotation", "scale", "opacity"):
        gradients[name] = np.zeros_like(raw[name])
        for column in range(raw[name].shape[1]):
            moved = raw | {name: raw[name].astype(complex)}
            moved[name][:, column] += 1j * STEP
            dalpha, dz = (values.imag / STEP for values in footprint(moved, camera, x, y))
            gradients[name][:, column] = np.sum(δalpha * dalpha + δz * dz, axis=1)
    return Exact(maps, gradients, weight > 0)


def _unsort(values: Array, order: Array) -> Array:
    out = np.empty_like(values)
    np.put_along_axis(out, order, values, axis=0)
    return out


def footprint(raw: dict[str, Array], camera: oracle.PinholeCamera, x: Array, y: Array) -> tuple[Array, Array]:
    """α before the cut, and depth (surfels, pixels), of real or complex channels."""
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    p = (raw["position"] - origin) @ to_camera.T
    u, v, n = (axis @ to_camera.T for axis in _axes(raw["rotation"]))
    sigma = np.exp(raw["scale"])
    opacity = 1 / (1 + np.exp(-raw["opacity"]))
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        t = np.sum(p * n, axis=1, keepdims=True) / (n @ ray)
        plane = sum(
            ((t * (axis @ ray) - np.sum(p * axis, axis=1, keepdims=True)) / sigma[:, i : i + 1]) ** 2
            for i, axis in enumerate((u, v))
        )
        middle_x = camera.fx * p[:, :1] / p[:, 2:] + camera.cx
        middle_y = camera.fy * p[:, 1:2] / p[:, 2:] + camera.cy
        screen = c.LOW_PASS_INV_VARIANCE * ((x - middle_x) ** 2 + (y - middle_y) ** 2)
        low_pass = ~(t.real > 0) | ~(screen.real >= plane.real)
        alpha = opacity * np.exp(-0.5 * np.where(low_pass, screen, plane))
    return np.where(alpha.real > c.ALPHA_MAX, c.ALPHA_MAX, alpha), np.where(low_pass, p[:, 2:], t)


def _axes(rotation: Array) -> tuple[Array, Array, Array]:
    """Images (N, 3) of the three axes under quaternions (x, y, z, w)."""
    x, y, z, w = (rotation / np.sqrt(np.sum(rotation**2, axis=1, keepdims=True))).T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1),
        np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1),
        np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1),
    )
