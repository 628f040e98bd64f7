"""Footprints of surfels and of 3D Gaussians in float64: each primitive is a class of four functions.

    culled(raw, camera, rules)             which rows (N,) cover no pixel
    footprint(raw, camera, rules, x, y)    Sample (N, P) at pixel centres x, y (P,)
    sort_key(raw, camera, pixels, corner)  depth (N, P) that orders rows in the tiles of pixels (raster);
                                           `corner`: the first pixel's place in its tile
    normal(raw)                            which of the three axes (N,) is the normal

Letters: N primitives, P pixels. Raw channels are real or, for derivatives by a complex step, complex.
"""

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.camera import (
    PinholeCamera,
    camera_frame,
    intrinsics,
    ray_slopes,
    rotation_axes,
    sigmoid,
)
from mi_refgs.reference.light import Array, clip

Corner = tuple[int, int]
Raw = dict[str, Array]  # channels by name
GEOMETRY = ("position", "rotation", "scale", "opacity")


@dataclass(frozen=True)
class Rules:
    """The named constants of footprints and compositing; others than the product's measure their bias."""

    alpha_min: float = c.ALPHA_MIN
    alpha_max: float = c.ALPHA_MAX
    transmittance_min: float = c.TRANSMITTANCE_MIN
    low_pass: float | None = c.LOW_PASS_INV_VARIANCE  # None: no screen-space filter
    edge_on: float = c.EDGE_ON_COSINE


@dataclass(frozen=True)
class Sample:
    """Footprints at pixels, (N, P) each."""

    alpha: Array  # after the clamp
    z: Array  # depth of the sample
    unclamped: Array  # real part of α before the clamp
    jump: Array  # relative distance of ρ to where depth jumps; infinite where it does not
    u: Array  # standard deviations from the centre along two axes, 0 where the low-pass decides
    v: Array


class Surfel:
    """Ray-plane intersection with a low-pass. [2DGS, Huang 2024, §4]"""

    @staticmethod
    def culled(raw: Raw, camera: PinholeCamera, rules: Rules) -> Array:
        centre, axes = camera_frame(raw, camera)
        facing = np.abs(np.sum(centre * axes[:, 2], axis=1))
        out = ~(centre[:, 2] > camera.near) | ~(facing > rules.edge_on * np.linalg.norm(centre, axis=1))
        return out | (sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)

    @staticmethod
    def footprint(raw: Raw, camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> Sample:
        p, axes = camera_frame(raw, camera)
        σ = np.exp(raw["scale"])
        ray = ray_slopes(camera, x, y)
        with np.errstate(all="ignore"):
            t = np.sum(p * axes[:, 2], axis=1)[:, None] / (axes[:, 2] @ ray)
            _, across = _from_centre(p, axes, ray)
            u, v = (t * across[i] / σ[:, i : i + 1] for i in range(2))
            plane = u**2 + v**2
            middle = [f * p[:, i : i + 1] / p[:, 2:] + m for i, (f, m) in enumerate(intrinsics(camera))]
            screen = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
            screen = screen * rules.low_pass if rules.low_pass else np.full_like(screen, np.inf)
            low_pass = ~(t.real > 0) | ~(screen.real >= plane.real)
            unclamped = sigmoid(raw["opacity"]) * np.exp(-0.5 * np.where(low_pass, screen, plane))
            jump = np.abs(screen.real - plane.real) / screen.real
        alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
        u, v = np.where(low_pass | ~np.isfinite(t), 0, [u, v])
        return Sample(alpha, np.where(low_pass, p[:, 2:], t), unclamped.real, jump, u, v)

    @staticmethod
    def normal(raw: Raw) -> Array:
        """The third axis."""
        return np.full(len(raw["position"]), 2)

    @staticmethod
    def turns(raw: Raw) -> Array:
        """What the normal gains per standard deviation (N, 6) along u, then along v, from `curvature`."""
        axes, κ, σ = rotation_axes(raw["rotation"]), raw["curvature"], np.exp(raw["scale"])
        turns = []
        for i in range(2):
            x, y = (σ[:, i] * κ[:, i + k] for k in range(2))
            scale = 1 / np.sqrt(1 + (x**2 + y**2) / c.MAX_TURN**2)
            turns.append((scale * x)[:, None] * axes[0] + (scale * y)[:, None] * axes[1])
        return np.concatenate(turns, axis=1)

    @staticmethod
    def sort_key(raw: Raw, camera: PinholeCamera, pixels: Array, corner: Corner) -> Array:
        """The depth of the plane at the tiles' centres, SORT_REACH σ from its own at most."""
        p, axes = camera_frame(raw, camera)
        σ = np.exp(raw["scale"])
        width, height = c.tile_size(abs(camera.fx), camera.fine)
        x = (pixels % camera.width + corner[0]) // width * width + width / 2 - corner[0]
        y = (pixels // camera.width + corner[1]) // height * height + height / 2 - corner[1]
        ray = ray_slopes(camera, x, y)
        with np.errstate(all="ignore"):
            k = 1 / p[:, 2:]
            lift, across = _from_centre(p, axes, ray)
            across = [across[i] / σ[:, i : i + 1] for i in range(2)]
            share = np.minimum(1, c.SORT_REACH * k / np.hypot(*across))
            return 1 / np.maximum(k + share * lift, k / c.SORT_DEPTH_RANGE)


class Gaussian:
    """3D Gaussians by EWA, Σ' = J W Σ Wᵀ Jᵀ + λ I, J at the centre, its slope clamped to around the image.
    [Zwicker 2001, eq. 31; 3DGS, Kerbl 2023, eq. 5]"""

    @staticmethod
    def culled(raw: Raw, camera: PinholeCamera, rules: Rules) -> Array:
        depth = camera_frame(raw, camera)[0][:, 2]
        return ~(depth > camera.near) | (sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)

    @staticmethod
    def footprint(raw: Raw, camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> Sample:
        p, axes = camera_frame(raw, camera)
        σ, z = np.exp(raw["scale"]), p[:, 2]
        along = []  # pixels on the screen of one standard deviation along each axis, (N, 3) in x and in y
        offsets = []  # pixels from the centres (N, P), in x and in y
        film = camera.film or ((0, camera.width), (0, camera.height))
        sides = zip((x, y), intrinsics(camera), film, strict=True)
        for i, (at, (focal, middle), (first, last)) in enumerate(sides):
            margin = c.GAUSSIAN_SLOPE_MARGIN * (last - first)
            ends = [(first - margin - middle) / focal, (last + margin - middle) / focal]
            slope = clip(p[:, i] / np.where(z == 0, 1, z), min(ends), max(ends))
            along.append(focal * σ * (axes[:, :, i] - slope[:, None] * axes[:, :, 2]) / z[:, None])
            offsets.append(at - (focal * p[:, i] / z + middle)[:, None])
        covariance = [[np.sum(a * b, axis=1) for b in along] for a in along]
        low_pass = c.GAUSSIAN_LOW_PASS if rules.low_pass else 0.0
        xx, yy, xy = covariance[0][0] + low_pass, covariance[1][1] + low_pass, covariance[0][1]
        determinant = (xx * yy - xy**2)[:, None]
        δx, δy = offsets
        with np.errstate(over="ignore"):
            rho = (yy[:, None] * δx**2 - 2 * xy[:, None] * δx * δy + xx[:, None] * δy**2) / determinant
            unclamped = sigmoid(raw["opacity"]) * np.exp(-0.5 * rho)
        alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
        depth, jump, none = (np.broadcast_to(x, alpha.shape) for x in (p[:, 2:], np.inf, 0.0))
        return Sample(alpha, depth, unclamped.real, jump, none, none)

    @staticmethod
    def sort_key(raw: Raw, camera: PinholeCamera, pixels: Array, corner: Corner) -> Array:
        """The depth of the centre, in every tile."""
        return np.repeat(camera_frame(raw, camera)[0][:, 2:], len(pixels), axis=1)

    @staticmethod
    def normal(raw: Raw) -> Array:
        """The shortest axis, the third of equal ones."""
        shortest = np.argmin(raw["scale"], axis=1)
        return np.where(raw["scale"][:, 2] <= raw["scale"].min(axis=1), 2, shortest)


def _from_centre(p: Array, axes: Array, ray: Array) -> tuple[Array, list[Array]]:
    """Difference (N, P) of 1 / depth to the centres', and offsets along t_u, t_v over depth, of rays (3, P):
    only the difference to the ray through the surfel's centre meets the axes, so that nothing cancels."""
    beside = ray[None] - (p / p[:, 2:])[:, :, None]
    lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / np.sum(p * axes[:, 2], 1)[:, None]
    along = [np.einsum("nk,nkp->np", axes[:, i], beside) for i in range(2)]
    return lift, [along[i] - lift * np.sum(p * axes[:, i], 1)[:, None] for i in range(2)]
