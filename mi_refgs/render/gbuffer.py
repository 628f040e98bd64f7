"""The G-buffer: named values of the surfels, composited together and divided by alpha once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.splat import Camera, splat, splat_compact
from mi_refgs.splat.lanes import CompactedPixels
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float, Point2f

OBJECT = "object"
"""Slot of the object's opacity; where it is blended, slots are divided by it."""


@dataclass(frozen=True)
class GBuffer:
    """Blended slots of a view, in raster order or in that of `pixels`. A slot that nobody needs is absent."""

    alpha: Float  # accumulated opacity
    depth: Float  # expected camera-z depth, 0 where nothing is seen; None if not asked for
    slots: dict[str, Any]  # premultiplied by alpha, each of the type that was blended
    inverse: Float  # 1/alpha or 1/opacity of the object where that is seen, else 0
    pixels: CompactedPixels | None

    @staticmethod
    def blend(
        surfels: Surfels,
        slots: Mapping[str, Any],  # (N,) each: mi.Float, or an array of several such as mi.Color3f
        camera: Camera,
        screen_offset: Point2f | None,
        compact: bool,
        depth: bool,
    ) -> GBuffer:
        """Blend values of surfels by name with `splat_compact`, or `splat`, which has the depth anyway.

        Every component is a feature, which costs time in every surfel-tile pair.
        """
        features = [part for value in slots.values() for part in parts(value)]
        if compact:
            blended = splat_compact(surfels, features, camera, depth=depth)
        else:
            blended = splat(surfels, features, camera, screen_offset)
        rest, maps = list(blended.features), {}
        for name, value in slots.items():
            width = len(parts(value))
            maps[name], rest = type(value)(*rest[:width]), rest[width:]
        inverse = inverse_alpha(blended.alpha)
        own = inverse_alpha(maps[OBJECT]) if OBJECT in maps else inverse
        mean_depth = None if blended.depth is None else blended.depth * inverse
        return GBuffer(blended.alpha, mean_depth, maps, own, blended.pixels)

    def divided(self, name: str) -> Any:
        """A slot divided by alpha or the object's opacity: the mean of what is seen, 0 where nothing is."""
        value = self.slots[name]
        return type(value)(*(part * self.inverse for part in parts(value)))


def inverse_alpha(alpha: Float) -> Float:
    """1/A where anything is seen (COVERAGE_FLOOR), else 0, with a finite gradient everywhere."""
    seen = alpha > COVERAGE_FLOOR
    return dr.select(seen, dr.rcp(dr.select(seen, alpha, 1)), 0)


def parts(value: Any) -> list[Float]:
    """The components of a value."""
    return [*value] if dr.depth_v(value) > 1 else [value]
