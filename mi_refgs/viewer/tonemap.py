"""Conversion of frames to what a page displays: the image or one of its AOVs, as 8-bit RGB."""

from __future__ import annotations

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
from mi_refgs.viewer.resolution import FINEST

IMAGE = "image"
"""What is displayed unless an AOV is chosen."""
BACKDROPS = {"white": 1.0, "grey": 0.25, "black": 0.0}
"""Display-encoded brightness behind the object, by name."""
ENVIRONMENT = "environment map"
"""The environment map as backdrop."""
BACKGROUND = "background"
"""The photographed background as backdrop; with all others the object only is displayed."""


def backdrops_of(background: bool, light: bool) -> tuple[str, ...]:
    """Return the backdrops of a scene that has these or not, the initial one first."""
    return (*((BACKGROUND,) if background else ()), *BACKDROPS, *((ENVIRONMENT,) if light else ()))


@dataclass(frozen=True)
class DisplayOptions:
    """What is displayed of a scene, and how: on all pages, which share their controls."""

    what: str = IMAGE  # or a type of `plugins.aovs`
    exposure: float = 0.0  # stops
    backdrop: str = "white"  # one of `backdrops_of`
    depths: tuple[float, float] = (0.0, 1.0)  # distances that are displayed as white and as black
    largest: int = FINEST  # finest resolution level at rest
    fixed: int | None = None  # resolution level during motion; None: by the time per image
    overlays: bool = False  # whether the browser draws over the image, which requires depth

    @property
    def object_only(self) -> bool:
        """Whether the background is left out."""
        return self.backdrop != BACKGROUND


def planes_of(frame: Frame, camera: Camera, look: DisplayOptions, light: Light | None) -> list[Float]:
    """Return what is averaged over samples, (H*W,) each: the premultiplied image or AOV, and alpha.

    For an image with background or environment map, three planes of that follow, times 1 - alpha.
    """
    if look.what != IMAGE:
        return aov_planes(look.what, frame, camera)
    behind = frame.background
    if behind is None and look.backdrop == ENVIRONMENT and light is not None:
        behind = light.radiance(dr.normalize(camera.rays()))
    through = () if behind is None else (1 - frame.alpha) * mi.Color3f(behind)
    return [*frame.radiance, frame.alpha, *through]


def composited(planes: list[Float], look: DisplayOptions) -> list[Float]:
    """Return linear RGBA, or the channels of the AOV, of the mean of `planes_of`."""
    if look.what != IMAGE:
        return values_of_planes(look.what, planes)
    radiance, alpha, behind = planes[:3], planes[3], planes[4:]
    if not behind:
        return [*radiance, alpha]
    return [*(plane + value for plane, value in zip(radiance, behind, strict=True)), mi.Float(1)]


def premultiplied(what: str, values: list[Float], alpha: Float) -> list[Float]:
    """Return the channels of an AOV, times alpha unless the AOV is, and alpha."""
    weighted = values if what in (*TERMS, "alpha") else [value * alpha for value in values]
    return [*weighted, alpha]


def displayed_planes(planes: list[Float], look: DisplayOptions) -> list[Float]:
    """Return display-encoded RGB planes, not clipped, of the mean of `planes_of`."""
    backdrop = BACKDROPS.get(look.backdrop, 1.0)
    values, alpha = composited(planes, look), planes[-1]
    if look.what == IMAGE or look.what in TERMS:
        gain = dr.opaque(mi.Float, 2.0**look.exposure)
        radiance = [value * gain for value in values[:3]]
        if look.what == IMAGE and len(planes) == 4:  # nothing behind the object
            return display_image(radiance, values[3], [backdrop] * 3)
        return [srgb_from_linear(value) for value in radiance]
    if look.what == "alpha":
        return values * 3
    match suffixes()[look.what]:
        case "XYZ":
            values = [0.5 + 0.5 * value for value in values]
        case "RGB":
            values = [srgb_from_linear(value) for value in values]
        case "T":
            near, far = (dr.opaque(mi.Float, x) for x in look.depths)
            values = [dr.clip((far - values[0]) / (far - near), 0, 1)]
    return [alpha * value + (1 - alpha) * backdrop for value in values * (3 // len(values))]


def to_bytes(planes: list[Float], width: int, height: int) -> np.ndarray:
    """Return 8-bit RGB (height, width, 3) of display-encoded planes, clipped; waits for the device."""
    packed = dr.zeros(mi.UInt32, width * height)
    for index, plane in enumerate(planes):
        packed |= mi.UInt32(dr.clip(plane, 0, 1) * 255 + 0.5) << (8 * index)
    pixels = np.array(packed.numpy(), dtype="<u4").view(np.uint8)
    return np.ascontiguousarray(pixels.reshape(height, width, 4)[..., :3])
