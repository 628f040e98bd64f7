"""The region of interest of an object: a sphere above planes, which have all cameras on one side, around the
group of close points that most views show. Before a fit, the sphere estimated from the cameras grows until it
contains that group; during a fit, with points on all surfaces, a sphere and more planes enclose it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from mi_refgs.data.region import CAMERA_SHARE, Plane, Region
from mi_refgs.data.view import View, evenly_spread

# Support planes; lengths are in radii of the region.
PLANE_REACH = 2.0  # distance from the centre up to which points determine them
PLANE_MARGIN = 0.04  # height above at which the region begins; half leaves 4 % of the outline to the table
PLANE_POINTS, PLANE_SHARE = 50, 0.05  # fewest points on one, and their share of those within PLANE_REACH
BELOW_SHARE = 0.5  # most points below over those on it: a table mirrors some, the face of an object has more
ABOVE_SHARE = 0.9  # fraction of the cameras that are above
PARALLEL = 0.9  # cosine of two normals from which the second is what the first has left
# The group of points of the object.
MOST_POINTS = 5_000  # of the points on a plane, and twice as many of a group: time and memory grow with them
SEEN_SHARE = 0.4  # fraction of the views that show a point; close views leave some parts out
LINK_COUNT = 5  # points within the distance of neighbours, itself included, of a point that is no stray one
GROUP_POINTS = 50  # fewest points of an object: fewer are texture on a part of it
WITHIN_SHARE = 0.95  # fraction inside of the region at which the region stays
LEAST_WITHIN = 0.5  # the same of points on fitted surfaces, below which something connects it to the scene
WHOLE = 0.95  # fraction in an image that shows the whole object
FREE_SHARE = 0.15  # of the centre's depth, empty before a camera; a table seen from 5° above begins at 0.18
# Balls around the group.
ENCLOSED, FITTED_BALL = 1.05, 1.1  # radius over that of the smallest ball: of sparse points, of fitted ones


@dataclass(frozen=True)
class Scatter:
    """How close to each other points on one surface are, in radii of the region."""

    width: float  # half the thickness of the points of a plane
    link: float  # distance of neighbours in a group
    lift: float = 0.0  # height above a plane up to which inaccurate points of the plane may lie


SPARSE = Scatter(0.01, 0.15)  # structure from motion: holds 98 % of the points on the cloth of *tabletop*
DENSE = Scatter(0.02, 0.08, 0.1)  # stereo: widths from 0.015, links to 0.1, lifts to 0.15 find the same
FITTED = Scatter(0.1, 0.08)  # halfway through a fit, a varnished table is off by 0.1; 0.06 to 0.15 find it

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
    points = points[np.linalg.norm(points - np.array(region.centre), axis=1) < PLANE_REACH * radius]
    points = rng.permutation(points)[:MOST_POINTS]
    least, found = max(PLANE_POINTS, PLANE_SHARE * len(points)), list[Plane]()
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
        x, y, z = map(float, up)
        found.append((x, y, z, level))
        points = points[points @ up > level]
    return tuple(found)


def object_region(
    region: Region, origins: np.ndarray, points: np.ndarray, seen: Seen, scatter: Scatter = SPARSE
) -> Region:
    """The region of an object, from the sphere that cameras (V, 3) suggest and points (N, 3) on surfaces."""
    region = replace(region, planes=support_planes(points, origins, region, scatter.width))
    group = object_points(region, points, seen, scatter)
    if len(group) < GROUP_POINTS or np.mean(region.contains(group)) >= WITHIN_SHARE:
        return region
    # The ball around the group and the part of the sphere above the planes, with the cameras outside.
    offset = np.random.default_rng(0).normal(size=(2_000, 3))
    offset *= region.radius / np.linalg.norm(offset, axis=1, keepdims=True)
    sphere = np.array(region.centre) + offset
    centre, radius = enclosing_ball(np.concatenate([group, sphere[region.above(sphere)]]))
    return _with_ball(region, centre, ENCLOSED * radius, origins)


def shown_whole(views: Sequence[View], region: Region, points: np.ndarray, scatter: Scatter = SPARSE) -> bool:
    """Whether an image shows the whole object, as far as points (N, 3) tell."""
    group = object_points(region, points, lambda chosen: np.ones(len(chosen)), scatter)
    return len(group) < GROUP_POINTS or any(np.mean(view.project(group)[2]) >= WHOLE for view in views)


def fitted_region(region: Region, origins: np.ndarray, points: np.ndarray, seen: Seen) -> Region | None:
    """The region of an object from points (N, 3) on all surfaces of a fit; None without a group of points: a
    ball and a box around it, above the planes of `region`, or, if it has none, above one of these points."""
    if not region.planes:
        region = replace(region, planes=support_planes(points, origins, region, FITTED.width, most=1))
    group = object_points(region, points, seen, FITTED)
    if len(group) < GROUP_POINTS or np.mean(region.contains(group)) < LEAST_WITHIN:
        return None
    centre, radius = enclosing_ball(group)
    if FITTED_BALL * radius > _room(centre, origins):
        centre, radius = _ball_beside_cameras(group, origins)
    region = _with_ball(region, centre, FITTED_BALL * radius, origins)
    axes = np.linalg.svd(group - group.mean(axis=0), full_matrices=False)[2]
    normals = np.concatenate([axes, -axes])
    offsets = np.min(group @ normals.T, axis=0) - 0.2 * region.radius  # thin parts may be missing
    box = [(a, b, c, d) for a, b, c, d in np.column_stack([normals, offsets]).tolist()]
    return replace(region, planes=(*region.planes, *box))


def _ball_beside_cameras(group: np.ndarray, origins: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) in a group (N, 3) around which a ball free of cameras has most; radius for all of it."""
    middle = group.mean(axis=0)
    outwards = group[evenly_spread(len(group), 100)] - middle
    centres = np.concatenate([middle + share * outwards for share in (0.0, 0.25, 0.5, 0.75)])
    away = cdist(centres, group)
    best = int(np.argmax(np.mean(away <= _room(centres, origins)[:, None], axis=1)))
    return centres[best], float(away[best].max())


def _with_ball(region: Region, centre: np.ndarray, radius: float, origins: np.ndarray) -> Region:
    """The region with another sphere, which is smaller if a camera is near."""
    x, y, z = map(float, centre)
    return replace(region, centre=(x, y, z), radius=min(radius, float(_room(centre, origins))))


def _room(centres: np.ndarray, origins: np.ndarray) -> np.ndarray:
    """Largest radius (...) of a region around centres (..., 3), with the cameras (V, 3) outside."""
    return np.asarray(CAMERA_SHARE * np.linalg.norm(origins - centres[..., None, :], axis=-1).min(axis=-1))


def object_points(region: Region, points: np.ndarray, seen: Seen, scatter: Scatter) -> np.ndarray:
    """The group (M, 3) of points (N, 3) above the planes that most views show, with most in the sphere."""
    near = np.linalg.norm(points - np.array(region.centre), axis=1) < PLANE_REACH * region.radius
    points = points[near & region.above(points, scatter.lift * region.radius)]
    points = np.random.default_rng(0).permutation(points)[: 2 * MOST_POINTS]
    points, link = points[seen(points) >= SEEN_SHARE], scatter.link * region.radius
    if len(points):
        points = points[KDTree(points).query_ball_point(points, link, return_length=True) >= LINK_COUNT]
    if not len(points):
        return points
    pairs = KDTree(points).query_pairs(link, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    return np.asarray(points[label == np.argmax(np.bincount(label, region.contains(points)))])


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
