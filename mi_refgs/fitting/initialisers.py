"""Where surfels start: functions from data and random draws to points, each registered under its name."""

from dataclasses import replace

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset, PointCloud
from mi_refgs.data.object_region import in_free_space, seen_share
from mi_refgs.data.region import Region
from mi_refgs.data.stereo import FARTHEST
from mi_refgs.errors import InputError
from mi_refgs.methods.extensions import Initialiser, Start, Wanted, register_initialiser
from mi_refgs.surfels import init

FARTHEST_CONTRACTED = 2 - 1 / FARTHEST  # of random points: beyond it the background map is as good
SEEN_SHARE = 0.1  # fraction of the views that must see a random point: fewer cannot determine its position
DRAWS = 64  # rounds of rejection sampling; cameras on one side of a scene accept about a tenth per round


def on_hull(wanted: Wanted) -> Start | None:
    """Points uniform on the hull's surface with its normals; a share uniform in its volume, since concave
    surfaces lie inside. Raises InputError if the masks have no point in common."""
    data, rng = wanted.data, wanted.rng
    if not data.has_alpha:
        return None
    views, behind = data.views, data.background
    shape = hull.visual_hull(views, hull.camera_bounds(views))
    inner = shape.inner_points(round(wanted.share * wanted.count), rng)
    outer, facing = shape.surface_points(wanted.count - len(inner), rng)
    normals = np.concatenate([facing, init.random_normals(len(inner), rng)])
    # Points inside face no view in particular: every view counts.
    colours = [hull.median_colours(outer, views, behind, facing), hull.median_colours(inner, views, behind)]
    return Start(np.concatenate([outer, inner]), np.concatenate(colours), normals)


def at_points(wanted: Wanted) -> Start | None:
    """At the points, with their colours or the images'; copies of a point lie as far away as its neighbours.
    In an open scene those on its side of the border, and a share elsewhere."""
    cloud, region, rng = wanted.data.points, wanted.region, wanted.rng
    if cloud is not None and region is not None:
        rows = region.contains(cloud.position) == wanted.inside
        cloud = PointCloud(cloud.position[rows], None if cloud.colour is None else cloud.colour[rows])
    if cloud is None or not len(cloud.position):
        return None
    drawn = 0 if region is None else round(wanted.share * wanted.count)
    elsewhere = replace(wanted, count=drawn)
    other = None if region is None else along_pixels(elsewhere) or at_random(elsewhere)
    if drawn == wanted.count:
        return other
    count = wanted.count - drawn
    row = rng.permutation(np.arange(count) % len(cloud.position))
    spread = init.neighbour_scale(cloud.position)[row] * (len(cloud.position) < count)
    points = cloud.position[row] + spread[:, None] * rng.normal(size=(count, 3))
    if cloud.colour is not None:
        colours = cloud.colour[row]
    else:
        colours = hull.median_colours(points, wanted.data.views, wanted.data.background)
    if other is None:
        return Start(points, colours)
    return Start(np.concatenate([points, other.position]), np.concatenate([colours, other.colour]))


def along_pixels(wanted: Wanted) -> Start | None:
    """Points outside of the region with the colours of pixels, of random depth, uniform in 1/z, beyond the
    region's centre: where points of surfaces are missing, and nowhere near a camera."""
    pixels, region, rng, count = wanted.data.unknown, wanted.region, wanted.rng, wanted.count
    if pixels is None or region is None or wanted.inside:
        return None
    points, colours = np.empty((0, 3)), np.empty((0, 3))
    while len(points) < count:
        some = rng.integers(len(pixels.origin), size=2 * count)
        nearest = np.linalg.norm(pixels.origin[some] - np.array(region.centre), axis=1)
        z = 1 / rng.uniform(1 / (nearest + FARTHEST * region.radius), 1 / nearest)
        drawn = pixels.origin[some] + pixels.direction[some] * z[:, None]
        outside = ~region.contains(drawn)
        points = np.concatenate([points, drawn[outside]])[:count]
        colours = np.concatenate([colours, pixels.colour[some][outside]])[:count]
    return Start(points, colours)


def at_random(wanted: Wanted) -> Start:
    """Points uniform where all cameras look, or in the region; the background's in contracted space."""
    data, region, rng = wanted.data, wanted.region, wanted.rng
    if region is None:
        low, high = hull.camera_bounds(data.views)
        points = rng.uniform(low, high, (wanted.count, 3))
    elif wanted.inside:
        points = _within(wanted.count, region, rng)
    else:
        points = _around(wanted.count, region, data, rng)
    return Start(points, hull.median_colours(points, data.views, data.background))


def _within(count: int, region: Region, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) uniform in the region; raises InputError if planes leave hardly any of its sphere."""
    found = np.empty((0, 3))
    for _ in range(DRAWS):
        number = (4 if region.planes else 1) * (count - len(found))
        offset = init.random_normals(number, rng) * np.cbrt(rng.random((number, 1))) * region.radius
        points = np.array(region.centre) + offset
        found = np.concatenate([found, points[region.above(points)]])[:count]
        if len(found) == count:
            return found
    raise InputError("they leave hardly anything of the sphere", "region", "planes", "correct or remove them")


def _around(count: int, region: Region, data: Dataset, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) uniform in contracted space outside of the region, in enough views if possible."""
    nearest = 0.0 if region.planes else 1.0  # the sphere has points below planes

    def draw(number: int) -> np.ndarray:
        length = np.cbrt(rng.uniform(nearest, FARTHEST_CONTRACTED**3, (number, 1)))
        points = region.expand(init.random_normals(number, rng) * length)
        return points[~region.contains(points)] if region.planes else points

    found = np.empty((0, 3))
    for _ in range(DRAWS):
        if len(found) == count:
            break
        points = draw(4 * (count - len(found)))
        points = points[seen_share(data.views, points) >= SEEN_SHARE]
        found = np.concatenate([found, points[~in_free_space(data.views, region, points)]])[:count]
    while len(found) < count:
        found = np.concatenate([found, draw(count - len(found))])
    return found


register_initialiser(Initialiser("hull", on_hull))
register_initialiser(Initialiser("points", at_points))
register_initialiser(Initialiser("along_pixels", along_pixels))
register_initialiser(Initialiser("random", at_random))
