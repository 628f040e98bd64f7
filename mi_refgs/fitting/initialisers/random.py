"""At random, in the colours that images have there."""

from __future__ import annotations

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.object_region import in_free_space, seen_share
from mi_refgs.data.region import Region
from mi_refgs.data.stereo import FARTHEST
from mi_refgs.errors import InputError
from mi_refgs.methods.extensions import Initialiser, Start, Wanted, register_initialiser
from mi_refgs.surfels import init

FARTHEST_CONTRACTED = 2 - 1 / FARTHEST  # of random points: beyond it the background map is as good
SEEN_SHARE = 0.1  # fraction of the views that must see a random point: fewer cannot determine its position
DRAWS = 64  # rounds of rejection sampling; cameras on one side of a scene accept about a tenth per round


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
        points = points[~in_free_space(data.views, region, points)]
        found = np.concatenate([found, points])[:count]
    while len(found) < count:
        found = np.concatenate([found, draw(count - len(found))])
    return found


register_initialiser(Initialiser("random", at_random))
