"""At known points, of a data set and of stereo, and along the pixels whose depth stereo has not found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mi_refgs.data import hull
from mi_refgs.data.dataset import PointCloud
from mi_refgs.data.stereo import FARTHEST
from mi_refgs.fitting.initialisers.random import at_random
from mi_refgs.methods.extensions import Initialiser, Start, Wanted, register_initialiser
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


register_initialiser(Initialiser("points", at_points))
register_initialiser(Initialiser("along_pixels", along_pixels))
