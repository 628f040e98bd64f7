"""Frames to what a page shows: the picture or one of its variables, as 8-bit RGB."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.plugins.aovs import aov_planes, suffixes, values_of_planes
from mi_refgs.render.display import display_image, srgb_from_linear
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.points import TERMS
from mi_refgs.splat.camera import Camera

IMAGE = "image"
"""What is shown unless a variable is asked for."""
BACKDROPS = {"white": 1.0, "grey": 0.25, "black": 0.0}
"""Display-encoded brightness behind the object, by name."""
ENVIRONMENT = "environment map"
"""The backdrop that is the light."""
BACKGROUND = "background"
"""The backdrop that is what the object was photographed in; all others show the object alone."""


def backdrops_of(surroundings: bool, light: bool) -> tuple[str, ...]:
    """The backdrops of a scene that has these or not; a page begins with the first."""
    return (*((BACKGROUND,) if surroundings else ()), *BACKDROPS, *((ENVIRONMENT,) if light else ()))


@dataclass(frozen=True)
class DisplayOptions:
    """What of the scene is shown, and how."""

    what: str = IMAGE  # or a type of `plugins.aovs`
    exposure: float = 0.0  # stops
    backdrop: str = "white"  # one of `backdrops_of`
    depths: tuple[float, float] = (0.0, 1.0)  # distances that are shown as white and as black

    @property
    def object_only(self) -> bool:
        """Whether the object is shown without its surroundings."""
        return self.backdrop != BACKGROUND


def planes_of(frame: Frame, camera: Camera, look: DisplayOptions, light: Light | None) -> list[Any]:
    """What is averaged over samples: the planes of the picture or variable, premultiplied, and alpha.

    For a picture with surroundings or the light behind it, three planes of that follow, times 1 - alpha.
    """
    if look.what == IMAGE:
        behind = frame.background
        if behind is None and look.backdrop == ENVIRONMENT and light is not None:
            behind = light.radiance(dr.normalize(camera.rays()))
        through = () if behind is None else (1 - frame.alpha) * mi.Color3f(behind)
        return [*frame.radiance, frame.alpha, *through]
    return aov_planes(look.what, frame, camera)


def seen_of(planes: list[Any], look: DisplayOptions) -> list[Any]:
    """Channels of an image from the mean of `planes_of`: linear RGBA, or those of the variable's AOV."""
    if look.what != IMAGE:
        return values_of_planes(look.what, planes)
    radiance, alpha, behind = planes[:3], planes[3], planes[4:]
    if not behind:
        return [*radiance, alpha]
    return [*(plane + value for plane, value in zip(radiance, behind, strict=True)), mi.Float(1)]


def shown_planes(planes: list[Any], look: DisplayOptions) -> list[Any]:
    """Three display-encoded planes of the mean of `planes_of`, not clipped."""
    backdrop = BACKDROPS.get(look.backdrop, 1.0)
    if look.what == IMAGE:
        gain = dr.opaque(mi.Float, 2.0**look.exposure)
        *seen, alpha = seen_of(planes, look)
        radiance = [plane * gain for plane in seen]
        if len(planes) == 4:
            return display_image(radiance, alpha, [backdrop] * 3)
        return [srgb_from_linear(plane) for plane in radiance]
    values, alpha = seen_of(planes, look), planes[-1]
    if look.what in TERMS:
        gain = dr.opaque(mi.Float, 2.0**look.exposure)
        return [srgb_from_linear(value * gain) for value in values]
    if look.what == "alpha":
        return values * 3
    kind = suffixes()[look.what]
    if kind == "XYZ":
        values = [0.5 + 0.5 * value for value in values]
    elif kind == "RGB":
        values = [srgb_from_linear(value) for value in values]
    elif kind == "T":
        near, far = (dr.opaque(mi.Float, x) for x in look.depths)
        values = [dr.clip((far - values[0]) / (far - near), 0, 1)]
    shown = values * (3 // len(values))
    return [alpha * value + (1 - alpha) * backdrop for value in shown]


def to_bytes(shown: list[Any], width: int, height: int) -> np.ndarray:
    """8-bit RGB (height, width, 3) of three display-encoded planes, clipped; waits for the device."""
    packed = dr.zeros(mi.UInt32, width * height)
    for index, plane in enumerate(shown):
        packed |= mi.UInt32(dr.clip(plane, 0, 1) * 255 + 0.5) << (8 * index)
    pixels = np.array(packed.numpy(), dtype="<u4").view(np.uint8)
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[..., :3])
