"""What a page displays: a scene that renders frames, and their conversion to display-encoded RGB."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.plugins.aovs import aov_planes, suffixes, values_of_planes
from mi_refgs.render.display import display_image, srgb_from_linear
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Float
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.resolution import FINEST

IMAGE = "image"  # what is displayed unless an AOV is chosen
BACKDROPS = {"white": 1.0, "grey": 0.25, "black": 0.0}
"""Display-encoded brightness behind the object, by name."""
ENVIRONMENT, BACKGROUND = "environment map", "background"
"""More backdrops: with all but the photographed background the object only is displayed."""


def backdrops_of(background: bool, light: bool) -> tuple[str, ...]:
    """Return the backdrops of a scene that has these or not, the initial one first."""
    return (*((BACKGROUND,) if background else ()), *BACKDROPS, *((ENVIRONMENT,) if light else ()))


@dataclass(frozen=True)
class DisplayOptions:
    """What is displayed of a scene, and how: on all pages, which share their controls."""

    what: str = IMAGE  # or a type of `plugins.aovs`
    exposure: float = 0.0  # stops
    backdrop: str = "white"  # one of `backdrops_of`
    largest: int = FINEST  # finest resolution level at rest

    @property
    def object_only(self) -> bool:
        """Whether the background is left out."""
        return self.backdrop != BACKGROUND

    @property
    def aovs(self) -> frozenset[str]:
        """The AOVs to render."""
        return frozenset({self.what} - {IMAGE, "alpha"})


class ViewerScene(ABC):
    """A scene that a page displays. The methods are called on the render thread."""

    variables: tuple[str, ...]  # IMAGE and the types of `plugins.aovs` that the scene has
    backdrops: tuple[str, ...]  # see `backdrops_of`
    centre: np.ndarray  # (3,) world, the point that cameras orbit
    radius: float  # of the object around it, scene units
    light: Light | None = None  # the environment map as backdrop

    @abstractmethod
    def frame(self, camera: Camera, look: DisplayOptions, settled: bool) -> Frame:
        """Render one sample per pixel; `settled`: nothing has moved for a while, so it may take longer."""

    def draw(self, camera: Camera, look: DisplayOptions, settled: bool) -> list[Float]:
        """Render planes of `planes_of`."""
        with dr.suspend_grad():
            return planes_of(self.frame(camera, look, settled), camera, look, self.light)

    def depths(self, pose: Pose) -> tuple[float, float]:
        """Return the distances of the object's front and back, which are displayed as white and as black."""
        distance = float(np.linalg.norm(pose.position - self.centre))
        return max(distance - self.radius, 0.0), distance + self.radius


def planes_of(frame: Frame, camera: Camera, look: DisplayOptions, light: Light | None) -> list[Float]:
    """Planes (H*W,) to average over samples: premultiplied image with what is behind, or AOV; alpha."""
    if look.what != IMAGE:
        return aov_planes(look.what, frame, camera)
    behind = frame.background
    if behind is None and look.backdrop == ENVIRONMENT and light is not None:
        behind = light.radiance(dr.normalize(camera.rays()))
    if behind is None:
        return [*frame.radiance, frame.alpha]
    return [*(frame.radiance + (1 - frame.alpha) * mi.Color3f(behind)), mi.Float(1)]


def displayed_planes(planes: list[Float], look: DisplayOptions, depths: tuple[float, float]) -> list[Float]:
    """Display-encoded RGB planes, not clipped, of the mean of `planes_of`; `depths` are white and black."""
    what, alpha, behind = look.what, planes[-1], BACKDROPS.get(look.backdrop, 1.0)
    values = planes if what == IMAGE else values_of_planes(what, planes)
    if what == IMAGE or what in TERMS:
        gain = dr.opaque(mi.Float, 2.0**look.exposure)
        radiance = [value * gain for value in values[:3]]
        if what == IMAGE:
            return display_image(radiance, alpha, [behind] * 3)
        return [srgb_from_linear(value) for value in radiance]
    if what == "alpha":
        return values * 3
    match suffixes()[what]:
        case "XYZ":
            values = [0.5 + 0.5 * value for value in values]
        case "RGB":
            values = [srgb_from_linear(value) for value in values]
        case "T":
            near, far = (dr.opaque(mi.Float, x) for x in depths)
            values = [dr.clip((far - values[0]) / (far - near), 0, 1)]
    return [alpha * value + (1 - alpha) * behind for value in values * (3 // len(values))]
