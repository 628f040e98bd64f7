"""Along the pixels of photographs whose depth is unknown, for the background."""

from __future__ import annotations

import numpy as np

from mi_refgs.data.stereo import FARTHEST
from mi_refgs.methods.initialiser import Initialiser, Start, Wanted, register


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


register(Initialiser("along_pixels", along_pixels))
