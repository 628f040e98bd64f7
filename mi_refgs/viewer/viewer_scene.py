"""The interface of scenes that a page displays."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import box_mean
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Float
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.resolution import GRID
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, planes_of


@dataclass(frozen=True, eq=False)
class SampleRequest:
    """One sample per pixel of an image."""

    pose: Pose
    width: int
    height: int
    look: DisplayOptions
    offset: tuple[float, float] = (0.0, 0.0)  # of the samples from the pixel centres, pixels
    index: int = 0  # of the sample
    settled: bool = False  # whether nothing has moved for a while, so that it may take longer
    exact: Camera | None = None  # replaces the pose, and has its own pixels

    @property
    def aovs(self) -> frozenset[str]:
        """The AOVs to render."""
        return frozenset({self.look.what, *(["depth"] if self.look.overlays else [])} - {IMAGE, "alpha"})

    def camera(self) -> Camera:
        """Return the renderer's camera."""
        return self.exact or self.pose.camera(self.width, self.height, self.offset)


class SampleResult(NamedTuple):
    """A rendered sample."""

    planes: list[Float]  # (H*W,) each, see `tonemap.planes_of`
    depth: Float | None = None  # (H*W,) along the camera's z axis, 0 where nothing is seen; None if unknown


class ViewerScene(ABC):
    """A scene that a page displays. The methods are called on the render thread."""

    variables: tuple[str, ...]  # `tonemap.IMAGE` and the types of `plugins.aovs` that the scene has
    backdrops: tuple[str, ...]  # see `tonemap.backdrops_of`
    centre: np.ndarray  # (3,) world, the point that cameras orbit
    radius: float  # of the object around it, scene units
    light: Light | None = None  # the environment map as backdrop
    square_pixels = False  # whether its pixels must be square, whatever sizes that gives

    @abstractmethod
    def frame(self, sample: SampleRequest) -> Frame:
        """Render one sample per pixel; a scene without frames defines `draw`."""

    def draw(self, sample: SampleRequest) -> SampleResult:
        """Render one sample per pixel, as what is displayed."""
        with dr.suspend_grad():
            frame = self.frame(sample)
            return SampleResult(planes_of(frame, sample.camera(), sample.look, self.light), frame.depth)

    @abstractmethod
    def cost(self) -> tuple[Shading, int]:
        """Return the shading and the number of surfels, which decide about passes."""

    def fine(self, request: SampleRequest) -> list[Float]:
        """Render an image to save, of square pixels: planes, means over GRID × GRID samples per pixel.

        Displayed images average samples that are filtered for the displayed pixels. Here each sample is
        filtered for its own footprint, as in `render.samples` and `refgs render`, in passes that fit into
        memory.
        """

        def means(camera: Camera) -> list[Float]:
            exact = camera.supersampled(GRID)
            drawn = self.draw(replace(request, height=camera.height, settled=True, exact=exact))
            pixels = dr.zeros(mi.Float, camera.width * camera.height)
            return [box_mean(plane, camera, GRID) + pixels for plane in drawn.planes]

        shading, surfels = self.cost()
        return in_passes(means, request.camera(), GRID, shading.neighbours, surfels)
