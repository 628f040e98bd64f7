"""The region of interest of an object: above planes that support it, around the group of close points that
most views show. Before a fit, the sphere estimated from the cameras grows until it contains that group; in a
fit, with points on all surfaces, the region encloses the group alone."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from mi_refgs.data.region import CAMERA_SHARE, Plane, Region
from mi_refgs.data.view import View

# Lengths are in radii of the region.
REACH = 2.0  # distance from the centre up to which points count
FEWEST = 50  # points of a plane, or of an object: fewer are texture on a part of it
MOST_POINTS = 5_000  # of the points on a plane, and twice as many of a group: time and memory grow with them
WHOLE = 0.98  # fraction of the group in a region, or in an image, that contains it
# Support planes.
PLANE_MARGIN = 0.02  # height above at which the region begins: twice the width of sparse points
PLANE_SHARE = 0.05  # least share of the points that are on one
BELOW_SHARE = 0.5  # most points below over those on it: a table mirrors some, the face of an object has more
ABOVE_SHARE = 0.9  # fraction of the cameras that are above
PARALLEL = 0.9  # cosine of two normals from which the second is what the first has left
# The group of points of the object.
SEEN_SHARE = 0.4  # fraction of the views that show a point; close views leave some parts out
LINK_COUNT = 5  # points within the distance of neighbours, itself included, of a point that is no stray one
LEAST_WITHIN = 0.5  # fraction in the region, below which something connects fitted surfaces to the scene
MARGIN = 0.2  # around the group, in radii of its ball: thin or blurred parts may be missing
FREE_SHARE = 0.15  # of the centre's depth, empty before a camera; a table seen from 5° above begins at 0.18

# The directions (26, 3) to the corners, edges and faces of a cube, then their opposites: a region is a sphere
# between planes with these normals. [k-DOP: Klosowski et al. 1998]
NORMALS = np.array([d for d in itertools.product((-1.0, 0.0, 1.0), repeat=3) if d > (0, 0, 0)])
NORMALS = np.concatenate([NORMALS, -NORMALS]) / np.linalg.norm([*NORMALS, *NORMALS], axis=1, keepdims=True)


@dataclass(frozen=True)
class Scatter:
    """How close to each other points on one surface are, in radii of the region."""

    width: float  # half the thickness of the points of a plane
    link: float  # distance of neighbours in a group
    lift: float  # height above the region's planes up to which inaccurate points of a plane may lie


SPARSE = Scatter(0.01, 0.15, 0.03)  # structure from motion: 98 % of the points on the cloth of *tabletop*
DENSE = Scatter(0.02, 0.08, 0.1)  # stereo: widths from 0.015, links to 0.1, lifts to 0.15 find the same
FITTED = Scatter(0.1, 0.08, 0.03)  # a varnished table is off by 0.1; widths from 0.06 to 0.15 find it

Seen = Callable[[np.ndarray], np.ndarray]  # fraction (N,) of the views that show points (N, 3)


def support_planes(
    points: np.ndarray,  # (N, 3)
    origins: np.ndarray,  # (V, 3) of the cameras
    region: Region,
    width: float = SPARSE.width,  # half the thickness of a plane, radii
    most: int = 3,  # a table, and a corner of two walls
) -> tuple[Plane, ...]:
    """Planes PLANE_MARGIN above surfaces that support an object, with nearly all cameras above them."""
    rng = np.random.default_rng(0)
    radius, width = region.radius, width * region.radius
    points = points[np.linalg.norm(points - np.array(region.centre), axis=1) < REACH * radius]
    points = rng.permutation(points)[:MOST_POINTS]
    least, found = max(FEWEST, PLANE_SHARE * len(points)), list[Plane]()
    while len(points) >= least and len(found) < most:
        # Planes through three points, with the cameras above.
        corner = points[rng.integers(len(points), size=(2_000, 3))]  # 30 good ones if a quarter is on one
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        length = np.linalg.norm(normal, axis=1, keepdims=True)
        normal /= np.where(length > 0, length, 1)
        offset = np.sum(normal * corner[:, 0], axis=1)
        upwards = np.sign(np.median(origins @ normal.T - offset, axis=0))
        normal, offset = normal * upwards[:, None], offset * upwards
        # The one that most points are on, of those that have little below.
        height = points @ normal.T - offset
        on, below = np.sum(abs(height) < width, axis=0), np.sum(height < -2 * width, axis=0)
        above = np.mean(origins @ normal.T > offset, axis=0)
        usable = (above >= ABOVE_SHARE) & (below <= BELOW_SHARE * on) & (length[:, 0] > 0)
        for x, y, z, _ in found:
            usable &= normal @ (x, y, z) < PARALLEL
        best = int(np.argmax(np.where(usable, on - below, -1)))
        if not usable[best] or on[best] < least:
            break
        up, level = normal[best], float(offset[best])
        for _ in range(5):
            near = points[abs(points @ up - level) < width]
            middle = near.mean(axis=0)
            across = np.linalg.svd(near - middle, full_matrices=False)[2][2]
            up = across * np.sign(across @ up)
            level = float(up @ middle)
        level += PLANE_MARGIN * radius
        found.append((*map(float, up), level))
        points = points[points @ up > level]
    return tuple(found)


def object_region(
    region: Region, origins: np.ndarray, points: np.ndarray, seen: Seen, scatter: Scatter = SPARSE
) -> Region:
    """The region of an object, from the sphere that cameras (V, 3) suggest and points (N, 3) on surfaces."""
    region = replace(region, planes=support_planes(points, origins, region, scatter.width))
    group = object_points(region, points, seen, scatter)
    if not len(group) or np.mean(region.contains(group)) >= WHOLE:
        return region
    # The part of the sphere above the planes stays: untextured parts of the object have no points.
    offset = np.random.default_rng(0).normal(size=(2_000, 3))
    offset *= region.radius / np.linalg.norm(offset, axis=1, keepdims=True)
    sphere = np.array(region.centre) + offset
    return enclosed(np.concatenate([group, sphere[region.above(sphere)]]), region, origins)


def shown_whole(views: Sequence[View], region: Region, points: np.ndarray, scatter: Scatter = SPARSE) -> bool:
    """Whether an image shows the whole object, as far as points (N, 3) tell."""
    group = object_points(region, points, lambda chosen: np.ones(len(chosen)), scatter)
    return not len(group) or any(np.mean(view.project(group)[2]) >= WHOLE for view in views)


def fitted_region(region: Region, origins: np.ndarray, points: np.ndarray, seen: Seen) -> Region | None:
    """The region of an object from points (N, 3) on all surfaces of a fit; None without a group of points. It
    is above the planes that support `region`, or, if there are none, above one of these points."""
    planes = region.supports or support_planes(points, origins, region, FITTED.width, most=1)
    region = replace(region, planes=planes)
    group = object_points(region, points, seen, FITTED)
    if not len(group) or np.mean(region.contains(group)) < LEAST_WITHIN:
        return None
    return enclosed(group, region, origins)


def enclosed(points: np.ndarray, region: Region, origins: np.ndarray) -> Region:
    """The ball around points (N, 3) and planes beside them, all MARGIN away, above those of `region`. A plane
    with a camera (V, 3) inside moves to the points, or, if it is among them, before it."""
    centre, radius = enclosing_ball(points)
    normals = NORMALS @ np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    nearest = np.min((points - centre) @ normals.T, axis=0)  # heights above planes through the centre
    lowest = nearest - MARGIN * radius
    for height in (origins - centre) @ normals.T:
        if np.all(height >= lowest):
            i = int(np.argmin(np.where(height < 0, height - nearest, np.inf)))
            lowest[i] = CAMERA_SHARE * height[i] if height[i] >= nearest[i] else nearest[i]
    middle = tuple(map(float, centre))
    hull = map(tuple, np.column_stack([normals, normals @ centre + lowest]).tolist())
    return replace(region, centre=middle, radius=(1 + MARGIN) * radius, planes=(*region.planes, *hull))


def object_points(region: Region, points: np.ndarray, seen: Seen, scatter: Scatter) -> np.ndarray:
    """The group (M, 3) of points (N, 3) above the planes that most views show, with most in the region; empty
    if these are fewer than FEWEST."""
    near = np.linalg.norm(points - np.array(region.centre), axis=1) < REACH * region.radius
    points = points[near & region.above(points, scatter.lift * region.radius)]
    points = np.random.default_rng(0).permutation(points)[: 2 * MOST_POINTS]
    points, link = points[seen(points) >= SEEN_SHARE], scatter.link * region.radius
    if len(points):
        points = points[KDTree(points).query_ball_point(points, link, return_length=True) >= LINK_COUNT]
    if not len(points):
        return points
    label = linked(points, link)
    within = np.bincount(label, region.contains(points))
    return np.asarray(points[(label == np.argmax(within)) & (within.max() >= FEWEST)])


def linked(points: np.ndarray, link: float) -> np.ndarray:
    """The number (N,) of each point's group: a chain of points (N, 3) not more than `link` apart."""
    pairs = KDTree(points).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    return np.asarray(connected_components(graph, directed=False)[1])


def enclosing_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of nearly the smallest ball around points (N, 3). [Bădoiu and Clarkson 2003]"""
    centre = points.mean(axis=0)
    for step in range(1, 501):  # the radius is right to 0.2 %
        farthest = points[np.argmax(np.sum((points - centre) ** 2, axis=1))]
        centre = centre + (farthest - centre) / (step + 1)
    return centre, float(np.linalg.norm(points - centre, axis=1).max())


def seen_share(views: Sequence[View], points: np.ndarray) -> np.ndarray:
    """Fraction (N,) of the views whose images contain points (N, 3)."""
    return np.asarray(np.mean([view.project(points)[2] for view in views], axis=0))


def in_free_space(views: Sequence[View], region: Region, points: np.ndarray) -> np.ndarray:
    """Mask (N,) of points (N, 3) that lie in an image, at less than FREE_SHARE of the object's depth.
    Photographs show nothing there; surfels there fit one image and hide the scene in others."""
    centre, found = np.array(region.centre), np.zeros(len(points), bool)
    for view in views:
        found |= view.project(points)[2] & (view.depth_of(points) < FREE_SHARE * view.depth_of(centre))
    return found


def camera_positions(views: Sequence[View]) -> np.ndarray:
    return np.array([view.to_world[:3, 3] for view in views])
