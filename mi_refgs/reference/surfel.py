"""Footprints of surfels in float64: ray-plane intersection with a low-pass. See `reference.footprint`."""

from __future__ import annotations

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.camera import PinholeCamera, camera_frame, intrinsics, ray_slopes, sigmoid
from mi_refgs.reference.footprint import Rules, Sample, tile_centres

Array = np.ndarray


def culled(raw: dict[str, Array], camera: PinholeCamera, rules: Rules) -> Array:
    """See `reference.footprint`."""
    centre, axes = camera_frame(raw, camera)
    facing = np.abs(np.sum(centre * axes[:, 2], axis=1))
    out = ~(centre[:, 2] > camera.near) | ~(facing > rules.edge_on * np.linalg.norm(centre, axis=1))
    return out | (sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)


def footprint(raw: dict[str, Array], camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> Sample:
    """See `reference.footprint`."""
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    ray = ray_slopes(camera, x, y)
    with np.errstate(all="ignore"):
        t = np.sum(p * axes[:, 2], axis=1)[:, None] / (axes[:, 2] @ ray)
        _, across = _from_centre(p, axes, ray)
        plane = sum((t * across[i] / σ[:, i : i + 1]) ** 2 for i in range(2))
        middle = [f * p[:, i : i + 1] / p[:, 2:] + m for i, (f, m) in enumerate(intrinsics(camera))]
        screen = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
        screen = screen * rules.low_pass if rules.low_pass else np.full_like(screen, np.inf)
        low_pass = ~(t.real > 0) | ~(screen.real >= plane.real)
        opacity = sigmoid(raw["opacity"])
        unclamped = opacity * np.exp(-0.5 * np.where(low_pass, screen, plane))
    alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
    z = np.where(low_pass, p[:, 2:], t)
    with np.errstate(all="ignore"):
        jump = np.abs(screen.real - plane.real) / screen.real
    return Sample(alpha, z, unclamped.real, jump)


def normal(raw: dict[str, Array]) -> Array:
    """The third axis."""
    return np.full(len(raw["position"]), 2)


def sort_key(raw: dict[str, Array], camera: PinholeCamera, pixels: Array, corner: tuple[int, int]) -> Array:
    """See `reference.footprint`; the depth of the plane, SORT_REACH σ from the centre at most."""
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    x, y = tile_centres(camera, pixels, corner)
    ray = ray_slopes(camera, x, y)
    with np.errstate(all="ignore"):
        k = 1 / p[:, 2:]
        lift, across = _from_centre(p, axes, ray)
        across = [across[i] / σ[:, i : i + 1] for i in range(2)]
        share = np.minimum(1, c.SORT_REACH * k / np.hypot(*across))
        return 1 / np.maximum(k + share * lift, k / c.SORT_DEPTH_RANGE)


def _from_centre(p: Array, axes: Array, ray: Array) -> tuple[Array, list[Array]]:
    """Where rays (3, P) meet the planes, relative to their centres p, over the depth there.

    Returns the difference (N, P) of 1 / depth to the centre's, and the offsets (N, P) along t_u and t_v. Only
    the difference to the ray through the surfel's own centre meets the axes: nothing cancels.
    """
    beside = ray[None] - (p / p[:, 2:])[:, :, None]
    lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / np.sum(p * axes[:, 2], 1)[:, None]
    along = [np.einsum("nk,nkp->np", axes[:, i], beside) for i in range(2)]
    return lift, [along[i] - lift * np.sum(p * axes[:, i], 1)[:, None] for i in range(2)]
