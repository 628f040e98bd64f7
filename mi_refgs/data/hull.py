"""Initial points: on and in the visual hull of alpha masks, or in a box, and their colours. `bounds` is a (2,
3) array: the lowest and highest corner of a box."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from mi_refgs.data.view import View
from mi_refgs.errors import InputError

HULL_RESOLUTION, HULL_LEAST = 96, 32  # voxels per edge, most and fewest: as pixels along the longer edge
HULL_LEVEL = 0.5  # mask level that bounds the hull
COLOUR_VIEWS = 32  # from which a point's median colour is computed; memory grows with points times views
FOCUS_CONDITION = 1e-3  # least singular value of the mean of (I - d dᵀ) over axes that meet; 0: parallel


def axis_projectors(axes: np.ndarray) -> np.ndarray | None:
    """I - d dᵀ (V, 3, 3) of view axes d (V, 3); None if they have no common point, as parallel ones."""
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    met = len(axes) and np.linalg.svd(projectors.mean(axis=0), compute_uv=False)[-1] >= FOCUS_CONDITION
    return projectors if met else None


def view_focus(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """The point nearest to all cameras' axes (3,), and their distances (V,); InputError for parallel axes."""
    origins = np.array([view.to_world[:3, 3] for view in views], dtype=np.float64).reshape(-1, 3)
    axes = np.array([view.to_world[:3, 2] for view in views], dtype=np.float64).reshape(-1, 3)
    projectors = axis_projectors(axes)
    if projectors is None:
        what, remedy = "they do not look at one point from several sides", "give the bounds of the scene"
        raise InputError(what, "views", "cameras", remedy)
    # Σ (I - d dᵀ)(p - o) = 0.
    focus = np.linalg.solve(projectors.mean(axis=0), np.einsum("nij,nj->i", projectors, origins) / len(views))
    return focus, np.linalg.norm(origins - focus, axis=1)


def camera_bounds(views: Sequence[View]) -> np.ndarray:
    """A cube (2, 3) around the point that all cameras look at, as wide as the widest view there."""
    focus, distance = view_focus(views)
    reach = [max(v.width / v.fx, v.height / v.fy) / 2 for v in views]
    half = min(float(np.max(distance * reach)), float(distance.max()))
    return np.stack([focus - half, focus + half])


@dataclass(frozen=True)
class Hull:
    """The visual hull of masks: a field on a grid, at most 0.5 on its border."""

    field: np.ndarray  # (X, Y, Z) float32, smallest mask value over the views; inside is above 0.5
    origin: np.ndarray  # (3,) world position of field[0, 0, 0]
    voxel: np.ndarray  # (3,) world distance of two samples along each axis

    def surface_points(self, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Uniform points (count, 3) on the surface (marching cubes), and outward unit normals (count, 3)."""
        from skimage.measure import marching_cubes

        vertices, faces, _, _ = marching_cubes(self.field, HULL_LEVEL)
        corners = vertices[faces].astype(np.float64)
        edges = [(corners[:, i] - corners[:, 0]) * self.voxel for i in (1, 2)]
        area = np.linalg.norm(np.cross(*edges), axis=1)
        face = rng.choice(len(faces), count, p=area / area.sum())
        # Uniform in a triangle: fold the unit square along its diagonal.
        first, second = rng.random((2, count))
        fold = first + second > 1
        first, second = np.where(fold, 1 - first, first), np.where(fold, 1 - second, second)
        a, b, c = (corners[face, i] for i in range(3))
        grid = a + first[:, None] * (b - a) + second[:, None] * (c - a)
        smooth = gaussian_filter(self.field, 1.0)
        slope = [map_coordinates(part, grid.T, order=1) for part in np.gradient(smooth)]
        normals = -np.stack(slope, axis=-1) / self.voxel
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        normals = np.where(length > 0, normals / np.where(length > 0, length, 1), [0.0, 0.0, 1.0])
        return self.origin + grid * self.voxel, normals

    def inner_points(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Uniform points (≤ count, 3) in the hull; fewer if it is small beside the cells that it touches."""
        corners = np.lib.stride_tricks.sliding_window_view(self.field, (2, 2, 2))
        cells = np.argwhere(corners.max(axis=(3, 4, 5)) > HULL_LEVEL)
        points = np.empty((0, 3))
        for _ in range(64):  # one keeps about a quarter for a voxel-thin sheet
            if not (missing := count - len(points)):
                break
            grid = cells[rng.integers(len(cells), size=2 * missing)] + rng.random((2 * missing, 3))
            inside = map_coordinates(self.field, grid.T, order=1) > HULL_LEVEL
            points = np.concatenate([points, grid[inside][:missing]])
        return self.origin + points * self.voxel


def visual_hull(views: Sequence[View], bounds: np.ndarray, resolution: int | None = None) -> Hull:
    """The set of points inside every mask (alpha > 0.5, blurred by half a voxel), which a quarter of the
    views must see. `resolution`: voxels per edge. Raises InputError if it is empty."""
    low, high = np.asarray(bounds, dtype=np.float64)
    if resolution is None:
        edge = max(max(view.width, view.height) for view in views)
        resolution = min(max(edge, HULL_LEAST), HULL_RESOLUTION)
    voxel = (high - low) / resolution
    centres = np.stack(np.meshgrid(*[np.arange(resolution)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    inside, witnesses = np.ones(resolution**3, np.float32), np.zeros(resolution**3, np.int32)
    alive = np.arange(resolution**3)
    middle = (low + high) / 2
    for view in views:
        row, column, seen = view.project(low + (centres[alive] + 0.5) * voxel)
        # The blur is limited to that of a camera one voxel from the centre.
        distance = max(float(np.linalg.norm(middle - view.to_world[:3, 3])), float(voxel.max()))
        blur = 0.5 * float(voxel.max()) * view.fx / distance
        mask = gaussian_filter(np.asarray(view.load().alpha, dtype=np.float32), blur, mode="nearest")
        value = map_coordinates(mask, np.stack([row[seen], column[seen]]), order=1, mode="nearest")
        inside[alive[seen]] = np.minimum(inside[alive[seen]], value)
        witnesses[alive[seen]] += 1
        dead = inside[alive] < 0.05  # carved, and not looked at again
        inside[alive[dead]] = 0
        alive = alive[~dead]
    inside[witnesses < 0.25 * len(views)] = 0  # what hardly any camera sees was never carved
    # One voxel closes a hull that touches the bounds; centres of voxels are half a voxel inside the box.
    field = np.pad(inside.reshape((resolution,) * 3), 1)
    if not np.any(field > HULL_LEVEL):
        what = "no point is inside every mask"
        raise InputError(what, "views", "alpha", "check cameras and masks, or do not use alpha")
    return Hull(field, low - 0.5 * voxel, voxel)


def median_colours(
    points: np.ndarray, views: Sequence[View], background: np.ndarray, normals: np.ndarray | None = None
) -> np.ndarray:
    """Median linear colour (N, 3) of the points over at most 32 views with alpha > 0.5 there, else 0.5 grey.
    With `normals`, only views in front count. The median is robust to occlusion, which is not tested."""
    if not views or not len(points):
        return np.full((len(points), 3), 0.5)
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, COLOUR_VIEWS).astype(int))]
    samples = np.full((len(chosen), len(points), 3), np.nan, dtype=np.float32)
    for sample, view in zip(samples, chosen, strict=True):
        row, column, seen = view.project(points)
        if normals is not None:
            seen = seen & (np.sum(normals * (view.to_world[:3, 3] - points), axis=1) > 0)
        at = np.rint([row[seen], column[seen]]).astype(int)
        pixel = tuple(np.clip(at, 0, np.array([[view.height], [view.width]]) - 1))
        view = view.load()
        opaque = np.full(at.shape[1], True) if view.alpha is None else view.alpha[pixel] > 0.5
        sample[np.flatnonzero(seen)[opaque]] = view.colour(background)[pixel][opaque]
    ordered = np.sort(samples, axis=0)  # NaN last
    number = np.count_nonzero(~np.isnan(ordered[..., 0]), axis=0)
    middle = ordered[np.maximum(number - 1, 0) // 2, np.arange(len(points))]
    return np.where(number[:, None] > 0, middle, 0.5).astype(np.float64)
