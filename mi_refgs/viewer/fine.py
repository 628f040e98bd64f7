"""A picture as `refgs render` makes it with 16 samples a pixel, in passes that fit into memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.render.passes import in_passes
from mi_refgs.render.samples import box_mean
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.viewer.develop import Look
from mi_refgs.viewer.drawable import Sample, Sampled
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.quality import GRID


def fine_planes(
    draw: Callable[[Sample], Sampled],
    pose: Pose,
    width: int,
    height: int,
    look: Look,
    shading: Shading,
    surfels: int,
) -> list[Any]:
    """Means over the samples of all pixels, planes as `draw` gives them.

    The samples of a page are those of the large picture, moved: their surfels are low-pass filtered for its
    pixels. Here they are for their own, as in `render.samples`.
    """

    def means(camera: Camera) -> list[Any]:
        exact = camera.supersampled(GRID)
        drawn = draw(Sample(pose, width, camera.height, look, settled=True, exact=exact))
        pixels = dr.zeros(mi.Float, camera.width * camera.height)
        return [box_mean(plane, camera, GRID) + pixels for plane in drawn.planes]

    return in_passes(means, pose.camera(width, height), GRID, shading.neighbours, surfels)
