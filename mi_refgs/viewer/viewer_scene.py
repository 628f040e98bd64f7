"""What a page displays of a scene, and the conversion of its frames to display-encoded RGB."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_refgs.plugins.aovs import aov_planes, suffixes, values_of_planes
from mi_refgs.render.display import display_image, srgb_from_linear
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Float
from mi_refgs.viewer.resolution import FINEST

IMAGE = "image"  # what is displayed unless an AOV is chosen
BACKDROPS = {"white": 1.0, "grey": 0.25, "black": 0.0}
"""Display-encoded brightness behind the object, by name."""
ENVIRONMENT, BACKGROUND = "environment map", "background"
"""More backdrops: with all but the photographed background the object only is displayed."""


@dataclass(frozen=True)
class DisplayOptions:
    """What is displayed of a scene, and how: on all pages, which share their controls."""

    what: str = IMAGE  # or a type of `plugins.aovs`
    exposure: float = 0.0  # stops
    backdrop: str = "white"  # one of those of the scene
    largest: int = FINEST  # finest resolution level at rest


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
