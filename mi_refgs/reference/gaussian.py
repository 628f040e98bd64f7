"""Footprints of 3D Gaussians in float64, by EWA. See `reference.footprint`.

The screen covariance is Σ' = J W Σ Wᵀ Jᵀ + λ I, with J the derivative of the projection at the centre, whose
slope is clamped to the neighbourhood of the image. [Zwicker 2001, eq. 31; 3DGS, Kerbl 2023, eq. 5]
"""

from __future__ import annotations

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.camera import PinholeCamera, camera_frame, intrinsics, sigmoid
from mi_refgs.reference.footprint import Rules, Sample

Array = np.ndarray


def culled(raw: dict[str, Array], camera: PinholeCamera, rules: Rules) -> Array:
    """See `reference.footprint`."""
    depth = camera_frame(raw, camera)[0][:, 2]
    return ~(depth > camera.near) | (sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)


def footprint(raw: dict[str, Array], camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> Sample:
    """See `reference.footprint`."""
    p, axes = camera_frame(raw, camera)
    σ, z = np.exp(raw["scale"]), p[:, 2]
    along = []  # pixels on the screen of one standard deviation along each axis, (N, 3) in x and in y
    for i, ((focal, _), limits) in enumerate(zip(intrinsics(camera), _limits(camera), strict=True)):
        slope = p[:, i] / np.where(z == 0, 1, z)
        slope = np.where(
            slope.real < limits[0], limits[0], np.where(slope.real > limits[1], limits[1], slope)
        )
        along.append(focal * σ * (axes[:, :, i] - slope[:, None] * axes[:, :, 2]) / z[:, None])
    covariance = [[np.sum(a * b, axis=1) for b in along] for a in along]
    low_pass = c.GAUSSIAN_LOW_PASS if rules.low_pass else 0.0
    xx, yy, xy = covariance[0][0] + low_pass, covariance[1][1] + low_pass, covariance[0][1]
    determinant = (xx * yy - xy**2)[:, None]
    δx, δy = (
        at - (focal * p[:, i] / z + middle)[:, None]
        for i, (at, (focal, middle)) in enumerate(zip((x, y), intrinsics(camera), strict=True))
    )
    with np.errstate(over="ignore"):
        rho = (yy[:, None] * δx**2 - 2 * xy[:, None] * δx * δy + xx[:, None] * δy**2) / determinant
        unclamped = sigmoid(raw["opacity"]) * np.exp(-0.5 * rho)
    alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
    depth = np.broadcast_to(p[:, 2:], alpha.shape)
    return Sample(alpha, depth, unclamped.real, np.full(alpha.shape, np.inf))


def sort_key(raw: dict[str, Array], camera: PinholeCamera, pixels: Array, corner: tuple[int, int]) -> Array:
    """See `reference.footprint`; the depth of the centre, in every tile."""
    return np.repeat(camera_frame(raw, camera)[0][:, 2:], len(pixels), axis=1)


def normal(raw: dict[str, Array]) -> Array:
    """The shortest axis, the third of equal ones."""
    shortest = np.argmin(raw["scale"], axis=1)
    return np.where(raw["scale"][:, 2] <= raw["scale"].min(axis=1), 2, shortest)


def _limits(camera: PinholeCamera) -> list[tuple[float, float]]:
    """Slopes p_x / p_z and p_y / p_z of the neighbourhood of the image."""
    limits = []
    for (focal, middle), (first, last) in zip(intrinsics(camera), camera.borders, strict=True):
        margin = c.GAUSSIAN_SLOPE_MARGIN * (last - first)
        ends = [(first - margin - middle) / focal, (last + margin - middle) / focal]
        limits.append((min(ends), max(ends)))
    return limits
