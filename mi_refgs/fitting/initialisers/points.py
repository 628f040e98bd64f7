"""At known points: those of a data set, and those of stereo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import PointCloud
from mi_refgs.fitting.initialisers.along_pixels import along_pixels
from mi_refgs.fitting.initialisers.random import at_random
from mi_refgs.methods.initialiser import Initialiser, Start, Wanted, register
from mi_refgs.surfels import init


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
    if drawn == wanted.count:
        return elsewhere(wanted, drawn)
    other = None if region is None else elsewhere(wanted, drawn)
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


def elsewhere(wanted: Wanted, count: int) -> Start:
    """So many points on its side of the border, but not at known ones."""
    fewer = replace(wanted, count=count)
    return along_pixels(fewer) or at_random(fewer)


register(Initialiser("points", at_points))
