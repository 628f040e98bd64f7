"""What a page can draw: one protocol of scenes, which the loop asks for pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.render.passes import in_passes
from mi_refgs.render.samples import box_mean
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.resolution import GRID
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions


@dataclass(frozen=True, eq=False)
class SampleRequest:
    """One sample of every pixel of a picture."""

    pose: Pose
    width: int
    height: int
    look: DisplayOptions
    offset: tuple[float, float] = (0.0, 0.0)  # of the sample from the pixel's centre, pixels
    index: int = 0  # of the sample
    settled: bool = False  # whether nothing has moved for a while, so that it may cost more
    exact: Camera | None = None  # in place of the pose, with its pixels
    depth: bool = False  # whether depth is wanted, too

    @property
    def asked(self) -> frozenset[str]:
        """What `render` is to make beside the picture."""
        shown = {self.look.what} - {IMAGE, "alpha"}
        return frozenset(shown | ({"depth"} if self.depth else set()))

    def camera(self) -> Camera:
        """The renderer's camera."""
        return self.exact or self.pose.camera(self.width, self.height, self.offset)


@dataclass(frozen=True, eq=False)
class SampleResult:
    """What a scene gives for a sample."""

    planes: list[Any]  # see `develop.planes_of`
    depth: Any = None  # mi.Float: along the camera's z axis, 0 where nothing is seen; None where unknown


class ViewerScene(Protocol):
    """A scene as a page shows it. All but the constants is called on one thread, that of the loop."""

    @property
    def variables(self) -> tuple[str, ...]:
        """`develop.IMAGE` and the types of `plugins.aovs` that it has."""

    @property
    def backdrops(self) -> tuple[str, ...]:
        """See `develop.backdrops_of`."""

    centre: np.ndarray
    """World point (3,) that cameras turn around."""
    radius: float
    """Of the object around it, scene units."""
    square_pixels: bool
    """Whether its pixels must be square, whatever sizes that gives."""

    def draw(self, sample: SampleRequest) -> SampleResult:
        """One sample of every pixel."""

    def fine(self, pose: Pose, width: int, height: int, look: DisplayOptions) -> list[Any]:
        """The planes of a picture to keep, of square pixels."""


def fine_planes(
    draw: Callable[[SampleRequest], SampleResult],
    pose: Pose,
    width: int,
    height: int,
    look: DisplayOptions,
    shading: Shading,
    surfels: int,
) -> list[Any]:
    """Means over the samples of all pixels, planes as `draw` gives them.

    The samples of a page are those of the large picture, moved: their surfels are low-pass filtered for its
    pixels. Here they are for their own, as in `render.samples`.
    """

    def means(camera: Camera) -> list[Any]:
        exact = camera.supersampled(GRID)
        drawn = draw(SampleRequest(pose, width, camera.height, look, settled=True, exact=exact))
        pixels = dr.zeros(mi.Float, camera.width * camera.height)
        return [box_mean(plane, camera, GRID) + pixels for plane in drawn.planes]

    return in_passes(means, pose.camera(width, height), GRID, shading.neighbours, surfels)
