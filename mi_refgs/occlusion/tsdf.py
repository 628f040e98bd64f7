"""Fuse depth maps of many views into one truncated signed distance field, over a box.

The sign is positive in free space. The state of a voxel follows from the views:

=======================================  ===================================================================
in front of, or just behind, a surface   running mean of (depth - z), truncated
in front of the background               +1; never "inside"
only further behind surfaces             -1: the inside that no view reaches; no wall behind the surface
in no view's image                       +1: nothing is known to be there
=======================================  ===================================================================
"""

from collections.abc import Iterable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Bool, Float, Int32

ALPHA_SOLID = 0.5  # opacity from which a pixel has a surface: a box filter's silhouette
TRUNCATION_VOXELS = 5.0  # of the signed distance. [Ref-Gaussian's released extraction; 2DGS, §6]
UNSEEN_VOTE = 0.1  # sightings per view before a surface up to which a voxel stays inside: no tunnels
RESOLUTION_MAX = 1023  # most voxels along one axis: three coordinates share one 32-bit word
BOX_QUANTILE = 0.02  # fraction of the points per side and axis that may be floaters
BOX_REACH = 0.25  # part of the quantiles' distance by which the box may grow beyond them: thin ends
BOX_FLOOR = 1e-6  # least margin, as part of the points' distance from the origin: float32
BOX_MARGIN = 0.05  # free space around the points, as part of the longest side: room for the truncation


@dataclass(frozen=True)
class TSDF:
    """Signed distance at the corners of a regular grid, in truncations, positive in free space."""

    volume: np.ndarray  # (nx, ny, nz) float32 in [-1, 1]
    origin: np.ndarray  # (3,) float64, world position of volume[0, 0, 0]
    voxel: float  # grid spacing, scene units


def bounds_from_points(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Box (lo, hi) with a margin around (N, 3) world points but NaN and floaters; InputError without any."""
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        lost = "the fit has diverged or pruned every surfel"
        raise InputError("no finite point to bound", "surfels", "position", lost)
    lo, hi = np.quantile(points, (BOX_QUANTILE, 1 - BOX_QUANTILE), axis=0)
    reach = BOX_REACH * (hi - lo)
    lo, hi = np.maximum(lo - reach, points.min(axis=0)), np.minimum(hi + reach, points.max(axis=0))
    # The floor keeps a box around a single point, which float32 can tell from its place; at the origin any.
    margin = max(BOX_MARGIN * float((hi - lo).max()), BOX_FLOOR * float(np.abs(points).max())) or 1.0
    return lo - margin, hi + margin


def fuse(
    views: Iterable[tuple[Float, Float, Camera]], bounds: tuple[np.ndarray, np.ndarray], resolution: int
) -> TSDF:
    """Fuse views (depth, alpha, camera) into a signed distance field over `bounds`. [Curless and Levoy 1996;
    weights behind the surface: Bylow et al. 2013]

    `resolution`: voxels along the longest side. Depths (expected camera z, scene units) and alphas are in
    raster order; alpha < ALPHA_SOLID is free space. Detached. Raises InputError for a
    resolution that does not fit."""
    lo, hi = (np.asarray(b, dtype=np.float64) for b in bounds)
    extent = hi - lo
    if not 2 <= resolution <= RESOLUTION_MAX:
        what = f"{resolution} is outside 2..{RESOLUTION_MAX}"
        raise InputError(what, "tsdf", "resolution", "choose 64 to 256")
    voxel = float(extent.max()) / resolution
    shape = np.ceil(extent / voxel - 1e-6).astype(int) + 1
    with dr.suspend_grad():
        grid = _Grid(shape, lo, voxel)
        for depth, alpha, camera in views:
            grid.integrate(depth, alpha, camera)
        return TSDF(grid.volume().reshape(shape), lo, voxel)


class _Grid:
    """Accumulators of one fusion."""

    def __init__(self, shape: np.ndarray, origin: np.ndarray, voxel: float) -> None:
        count = int(np.prod(shape))
        flat = dr.arange(mi.UInt32, count)
        nz, nyz = dr.opaque(mi.UInt32, int(shape[2])), dr.opaque(mi.UInt32, int(shape[1] * shape[2]))
        yz = flat % nyz
        # Integer division is slow and would run for every view: keep the three coordinates, 10 bits each.
        self.corner = (flat // nyz) | ((yz // nz) << 10) | ((yz % nz) << 20)
        self.lo = mi.Point3f(*(dr.opaque(mi.Float, float(c)) for c in origin))
        self.voxel = dr.opaque(mi.Float, voxel)
        self.total, self.weight, self.behind = (dr.zeros(mi.Float, count) for _ in range(3))
        dr.eval(self.corner, self.total, self.weight, self.behind)

    def integrate(self, depth: Float, alpha: Float, camera: Camera) -> None:
        """Add one view."""
        width, height = dr.opaque(mi.Int32, camera.width), dr.opaque(mi.Int32, camera.height)
        # Surface depth, or 0 for background; NaN and infinite depths are background too.
        surface = dr.select((alpha >= ALPHA_SOLID) & (depth > camera.near) & dr.isfinite(depth), depth, 0)
        dr.eval(surface)

        corner = mi.Point3f(self.corner & 1023, (self.corner >> 10) & 1023, self.corner >> 20)
        point = camera.to_camera(corner * self.voxel + self.lo)
        in_front = point.z > camera.near
        inv_z = dr.rcp(dr.select(in_front, point.z, 1))
        # Relative to the centre of pixel (0, 0), where its texel sits.
        px = point.x * inv_z * camera.fx + camera.cx - 0.5
        py = point.y * inv_z * camera.fy + camera.cy - 0.5
        in_image = in_front & (px >= -0.5) & (py >= -0.5)
        in_image &= (px < mi.Float(width) - 0.5) & (py < mi.Float(height) - 0.5)
        trunc = TRUNCATION_VOXELS * self.voxel
        near, same_surface, background = _sample(surface, px, py, width, height, trunc, in_image)

        distance = near - point.z
        hit = in_image & same_surface
        banded = hit & (distance > -trunc)
        # Full weight down to one voxel behind the surface, then falling to 0 at the truncation.
        weight = dr.clip((distance + trunc) / (trunc - self.voxel), 0, 1)
        weight = dr.select(banded, weight, 0) + dr.select(in_image & background, mi.Float(1), 0)
        self.behind += dr.select(hit & ~banded, mi.Float(1), 0)
        distance = dr.select(background, trunc, distance)
        self.weight += weight
        self.total += dr.select(weight > 0, weight * dr.minimum(distance / trunc, 1), 0)
        dr.eval(self.total, self.weight, self.behind)

    def volume(self) -> np.ndarray:
        inside = (self.behind > 0) & (self.weight <= UNSEEN_VOTE * self.behind)
        observed = self.weight > 0
        mean = self.total / dr.select(observed, self.weight, 1)
        return np.array(dr.select(inside, -1, dr.select(observed, mean, 1)), dtype=np.float32)


def _sample(
    surface: Float, px: Float, py: Float, width: Int32, height: Int32, apart: Float, active: Bool
) -> tuple[Float, Bool, Bool]:
    """Depth at a pixel position, whether it is a surface, and certainly background (not a silhouette).
    Bilinear where the four texels differ by less than `apart`, else the nearest."""
    fx, fy = dr.floor(px), dr.floor(py)
    wx, wy = px - fx, py - fy
    x0, y0 = mi.Int32(fx), mi.Int32(fy)
    taps = []
    for dy in (0, 1):
        row = dr.clip(y0 + dy, 0, height - 1) * width
        taps += [dr.gather(mi.Float, surface, row + dr.clip(x0 + dx, 0, width - 1), active) for dx in (0, 1)]
    least = dr.minimum(dr.minimum(taps[0], taps[1]), dr.minimum(taps[2], taps[3]))
    most = dr.maximum(dr.maximum(taps[0], taps[1]), dr.maximum(taps[2], taps[3]))
    smooth = (least > 0) & (most - least < apart)
    bilinear = dr.lerp(dr.lerp(taps[0], taps[1], wx), dr.lerp(taps[2], taps[3], wx), wy)
    right, lower = wx >= 0.5, wy >= 0.5
    nearest = dr.select(lower, dr.select(right, taps[3], taps[2]), dr.select(right, taps[1], taps[0]))
    return dr.select(smooth, bilinear, nearest), nearest > 0, most == 0
