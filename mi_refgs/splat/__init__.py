"""Surfels to screen: project footprints, list them by tile, blend any number of channels front to back."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.timing import boundary, phase
from mi_refgs.splat.blend import Blended, blend
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.shown import Shown, blend_shown
from mi_refgs.splat.tiles import TileLists, list_by_tile
from mi_refgs.surfels.primitives import Footprints
from mi_refgs.surfels.table import Surfels

__all__ = [
    "Blended",
    "Camera",
    "Footprints",
    "Shown",
    "TileLists",
    "blend",
    "blend_shown",
    "list_by_tile",
    "project",
    "splat",
    "splat_shown",
]


@phase("project")
def project(surfels: Surfels, camera: Camera, screen_offset: Any = None) -> Footprints:
    """Footprints of a table's own primitive in a camera; `screen_offset` as `Primitive.project` has it."""
    return surfels.primitive.project(surfels, camera, screen_offset)


def splat(surfels: Surfels, features: list[Any], camera: Camera, screen_offset: Any = None) -> Blended:
    """Splat per-surfel features (K × mi.Float (N,)) to maps of H·W pixels; derivatives as in `blend`.

    `screen_offset` (mi.Point2f (N,), zeros, pixels) receives the gradient of a screen translation.
    """
    if surfels.count == 0:
        blank = [dr.zeros(mi.Float, camera.width * camera.height) for _ in range(len(features) + 2)]
        return Blended(blank[2:], *blank[:2])
    footprints = project(surfels, camera, screen_offset)
    lists = list_by_tile(footprints, camera)
    footprints, features = boundary((footprints, features), "surfels backward")
    return boundary(blend(footprints, features, lists, camera), "splat backward")


def splat_shown(surfels: Surfels, features: list[Any], camera: Camera, depth: bool) -> Shown:
    """The maps of `splat` for a picture alone, as `blend_shown` gives them."""
    if surfels.count == 0:
        return Shown.nothing(len(features), camera, depth)
    footprints = project(surfels, camera)
    return blend_shown(footprints, features, list_by_tile(footprints, camera), camera, depth)
