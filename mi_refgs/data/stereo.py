"""Points on the surfaces that photographs with known cameras show, by plane sweep, and the other pixels.
Patches of each view are compared with its neighbours at a series of depths [Collins 1996]; a pixel becomes a
point if the patches at its best depth look alike, and the best depths of other views agree with it."""

import itertools
import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates, uniform_filter

from mi_refgs.constants import NORM_FLOOR
from mi_refgs.data.dataset import PixelRays, PointCloud
from mi_refgs.data.region import Region
from mi_refgs.data.view import View, evenly_spread

FEWEST = 3  # views that are compared: AGREED ones confirm a depth
PIXELS = 16_000  # of the images that are compared, at most about
NEIGHBOURS = 4  # views with which each is compared
ALIKE = 2  # of these, the most similar count: others may not see a surface
DEPTHS = 64  # depths that are compared, evenly spaced in 1/z
NEAREST = 0.35  # the first of them, in distances of the cameras from the region's centre
FARTHEST = 20.0  # the last one, in radii of the region beyond its centre; random points end there, too
PATCH = 5  # side of a compared patch, pixels
CONTRAST = 0.0045  # standard deviation of a patch, 0 … 1, below which it has no texture: one level of 256
SIMILAR, SIMILAR_CONFIRMING = 0.75, 0.5  # correlation from which a depth counts, and confirms another
VOXEL = 0.03  # side of the voxels that are left with one point, in contracted space
LEAST = 50  # points that are left: fewer are chance
MOST = 50_000  # pixels with and without a point that are returned: more than a fit starts with
AGREED = 2  # views that confirm a depth


@dataclass(frozen=True, eq=False)
class _Swept:
    """A small view with its neighbours, and the best depth of each pixel."""

    view: View
    near: list[int]  # indices of the views with which it is compared
    nearness: np.ndarray  # (H, W) 1/z
    similarity: np.ndarray  # (H, W) of the patches there, -1 without texture


@dataclass(frozen=True, eq=False)
class Stereo:
    points: PointCloud  # of some pixels, so that what all views show has the most
    spaced: np.ndarray  # (P, 3) evenly in the region, and farther apart with their distance from it
    unknown: PixelRays  # some of the pixels without a point


def stereo(views: Sequence[View], region: Region) -> Stereo | None:
    """Compare views; None if there are fewer than FEWEST, or fewer than LEAST spaced points."""
    if len(views) < FEWEST:
        return None
    centre = np.array(region.centre)
    small = [views[i] for i in evenly_spread(len(views), 64)]  # half a second each
    small = [v.averaged(max(1, round(math.sqrt(v.width * v.height / PIXELS)))) for v in small]
    grey = [view.displayed.mean(axis=-1, dtype=np.float32) for view in small]
    distance = float(np.median([np.linalg.norm(view.to_world[:3, 3] - centre) for view in small]))
    farthest = distance + FARTHEST * region.radius
    nearness = np.linspace(1 / (NEAREST * distance), 1 / farthest, DEPTHS, dtype=np.float32)
    outward = np.array([view.to_world[:3, 3] for view in small]) - centre
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), NORM_FLOOR)
    away = abs(np.degrees(np.arccos(np.clip(outward @ outward.T, -1, 1))) - 12)  # off the preferred angle
    np.fill_diagonal(away, np.inf)
    nearest = np.argsort(away, kind="stable")[:, : min(NEIGHBOURS, len(small) - 1)].tolist()
    others = [[(small[j], grey[j]) for j in near] for near in nearest]
    with ThreadPoolExecutor(8) as pool:  # each takes 0.1 GB
        found = pool.map(_sweep, small, grey, others, itertools.repeat(nearness))
        swept = [_Swept(view, near, *best) for view, near, best in zip(small, nearest, found, strict=True)]
    tolerance = 0.75 * float(nearness[0] - nearness[1])  # within which two depths agree
    # The pixels whose depth others confirm, and the rest.
    position, on, off = [], [], []
    for one in swept:
        view, ray = one.view, one.view.rays(*np.indices(one.nearness.shape))
        colour = view.colour(np.zeros(3))
        points = view.to_world[:3, 3] + ray / one.nearness[..., None]
        known = _confirmed(one, points, [swept[j] for j in one.near], tolerance)
        position.append(points[known])
        on.append(colour[known])
        off.append((np.broadcast_to(view.to_world[:3, 3], ray[~known].shape), ray[~known], colour[~known]))
    points, colours = np.concatenate(position), np.concatenate(on)
    voxel = np.floor(region.contract(points) / VOXEL)
    _, first, count = np.unique(voxel, axis=0, return_index=True, return_counts=True)
    spaced = points[first[count >= 3]]  # one in each voxel on a surface; stray ones are alone
    if len(spaced) < LEAST:
        return None
    rays, rng = [np.concatenate(parts) for parts in zip(*off, strict=True)], np.random.default_rng(0)
    some, rest = rng.permutation(len(points))[:MOST], rng.permutation(len(rays[0]))[:MOST]
    return Stereo(PointCloud(points[some], colours[some]), spaced, PixelRays(*(part[rest] for part in rays)))


def _sweep(
    view: View, grey: np.ndarray, others: Sequence[tuple[View, np.ndarray]], nearness: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Best 1/z of each pixel, refined between two depths of the sweep, and the similarity of the patches."""
    mean = uniform_filter(grey, PATCH)
    variance = uniform_filter(grey * grey, PATCH) - mean * mean
    ray = view.rays(*np.indices(grey.shape))
    volumes = np.empty((len(others), len(nearness), *grey.shape), np.float32)
    for volume, (other, image) in zip(volumes, others, strict=True):
        # A point at depth z is (along + nearness · offset) z in the other camera's frame.
        rotation = other.to_world[:3, :3]
        along = ray @ rotation
        offset = (view.to_world[:3, 3] - other.to_world[:3, 3]) @ rotation
        x, y, z = (along[..., k] + nearness[:, None, None] * offset[k] for k in range(3))
        z = np.where(z > 0, z, np.nan)
        place = other.cy - 0.5 - other.fy * y / z, other.cx - 0.5 - other.fx * x / z
        inside = (place[0] >= 0) & (place[0] <= other.height - 1)
        inside &= (place[1] >= 0) & (place[1] <= other.width - 1)
        seen = map_coordinates(image, [np.where(inside, p, 0) for p in place], order=1)
        volume[:] = _correlation(grey, mean, variance, seen)
        volume[~inside] = -1
    similarity = np.sort(volumes, axis=0)[-ALIKE:].mean(axis=0)
    # The best depth, and the maximum of the parabola through it and its neighbours.
    best = np.argmax(similarity[1:-1], axis=0)[None] + 1
    before, there, after = (np.take_along_axis(similarity, best + k, axis=0)[0] for k in (-1, 0, 1))
    bend = before - 2 * there + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, 1), 0)
    step = nearness[1] - nearness[0]
    textured = variance > CONTRAST**2
    return nearness[best[0]] + np.clip(shift, -0.5, 0.5) * step, np.where(textured, there, -1)


def _correlation(grey: np.ndarray, mean: np.ndarray, variance: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Normalised cross-correlation of patches of an image (H, W) and of images (D, H, W)."""
    size = (1, PATCH, PATCH)
    mean_seen = uniform_filter(seen, size)
    variance_seen = uniform_filter(seen * seen, size) - mean_seen * mean_seen
    covariance = uniform_filter(grey * seen, size) - mean * mean_seen
    floor = np.float32(CONTRAST**2 / 2)
    return covariance / np.sqrt(np.maximum(variance, floor) * np.maximum(variance_seen, floor))


def _confirmed(one: _Swept, points: np.ndarray, others: Sequence[_Swept], tolerance: float) -> np.ndarray:
    """Mask (H, W) of the pixels whose points (H, W, 3) AGREED views show within `tolerance` in 1/z."""
    known = one.similarity >= SIMILAR
    candidates = points[known]
    agreed = np.zeros(len(candidates), int)
    for other in others:
        row, column, inside = other.view.project(candidates)
        at = tuple(np.where(inside, place, 0).round().astype(int) for place in (row, column))
        nearness = 1 / np.where(inside, other.view.depth_of(candidates), np.inf)
        same = abs(other.nearness[at] - nearness) < tolerance
        agreed += inside & same & (other.similarity[at] >= SIMILAR_CONFIRMING)
    known[known] = agreed >= AGREED
    return known
