"""A picture as `refgs render` makes it with 16 samples a pixel, in strips that fit into memory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.render.samples import box_mean
from mi_refgs.viewer.develop import Look
from mi_refgs.viewer.drawable import Sample, Sampled
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.quality import GRID, MULTIPLE

STRIP = 1 << 20
"""Samples that are drawn together: as many as the largest picture on a page has."""


def fine_planes(
    draw: Callable[[Sample], Sampled], pose: Pose, width: int, height: int, look: Look
) -> list[Any]:
    """Means over the samples of all pixels, planes as `draw` gives them.

    The samples of a page are those of the large picture, moved: their surfels are low-pass filtered for its
    pixels. Here they are for their own, as in `render.samples`.
    """
    camera = pose.camera(width, height)
    rows = max(STRIP // (width * GRID**2) // MULTIPLE, 1) * MULTIPLE
    strips = []
    for top in range(0, height, rows):
        count = min(rows, height - top)
        strip = replace(camera, height=count, cy=camera.cy - top, offset=(0, top))
        planes = draw(Sample(pose, width, count, look, settled=True, exact=strip.supersampled(GRID))).planes
        means = [box_mean(plane, strip, GRID) + dr.zeros(mi.Float, width * count) for plane in planes]
        dr.eval(means)
        strips.append(means)
    return [dr.concat(list(parts)) if len(parts) > 1 else parts[0] for parts in zip(*strips, strict=True)]
