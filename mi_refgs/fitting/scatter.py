"""Points to start from where pictures have no alpha: sparse points, and random ones in and around a region.

Positions are world positions in scene units; colours linear radiance.
"""

from __future__ import annotations

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.readers import PointCloud
from mi_refgs.data.region import Region
from mi_refgs.surfels import init

FARTHEST = 1.95
"""Contracted distance of the farthest random points, 20 radii of the region: beyond it the background is as
good."""
SEEN_SHARE = 0.1
"""Share of the views that must see a random point: what fewer see, they cannot place."""
DRAWS = 64
"""Rounds of rejection; cameras on one side of a scene keep about a tenth of a round."""


def inside_points(
    count: int, random: float, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) of the object and their colours: a share `random` uniform in the region, the others
    at sparse points in there, if there are any."""
    region = data.region
    assert region is not None
    sparse = _part(data.points, region, inside=True)
    drawn = count if sparse is None else round(random * count)
    direction = init.random_normals(drawn, rng)
    offset = direction * np.cbrt(rng.random((drawn, 1))) * region.radius
    return _both(sparse, count - drawn, np.array(region.centre) + offset, data, rng)


def outside_points(
    count: int, random: float, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) of the surroundings and their colours: a share `random` uniform in contracted space
    where views see it, the others at sparse points outside of the region, if there are any."""
    region = data.region
    assert region is not None
    sparse = _part(data.points, region, inside=False)
    drawn = count if sparse is None else round(random * count)
    return _both(sparse, count - drawn, _around(drawn, region, data, rng), data, rng)


def at_points(
    cloud: PointCloud, count: int, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points (count, 3) at those of a cloud, with their colours or those of the pictures.

    Copies of a point lie around it, as far off as its neighbours do: their distance is a surfel's size.
    """
    known = cloud.position
    row = rng.permutation(np.arange(count) % len(known))
    spread = init.neighbour_scale(known)[row] * (len(known) < count)
    points = known[row] + spread[:, None] * rng.normal(size=(count, 3))
    if cloud.colour is not None:
        return points, cloud.colour[row]
    return points, hull.median_colours(points, data.views, data.background)


def _both(
    sparse: PointCloud | None, count: int, drawn: np.ndarray, data: Dataset, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """So many points of a cloud, and those that were drawn."""
    colours = hull.median_colours(drawn, data.views, data.background)
    if sparse is None or not count:
        return drawn, colours
    points, known = at_points(sparse, count, data, rng)
    return np.concatenate([points, drawn]), np.concatenate([known, colours])


def _part(cloud: PointCloud | None, region: Region, inside: bool) -> PointCloud | None:
    """The points of a cloud on one side of the region's border; None without one."""
    if cloud is None:
        return None
    rows = region.contains(cloud.position) == inside
    if not rows.any():
        return None
    return PointCloud(cloud.position[rows], None if cloud.colour is None else cloud.colour[rows])


def _around(count: int, region: Region, data: Dataset, rng: np.random.Generator) -> np.ndarray:
    """Points (count, 3) uniform in the contracted shell around the region, as far as enough views see them;
    wherever they are if hardly any are seen."""
    found = np.empty((0, 3))
    for _ in range(DRAWS):
        missing = count - len(found)
        if missing <= 0:
            break
        length = np.cbrt(rng.uniform(1, FARTHEST**3, (4 * missing, 1)))
        points = region.expand(init.random_normals(4 * missing, rng) * length)
        views = [view.project(points)[2] for view in data.views]
        seen = np.mean(views, axis=0) >= SEEN_SHARE
        found = np.concatenate([found, points[seen][:missing]])
    missing = count - len(found)
    length = np.cbrt(rng.uniform(1, FARTHEST**3, (missing, 1)))
    return np.concatenate([found, region.expand(init.random_normals(missing, rng) * length)])
