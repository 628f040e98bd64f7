"""The G-buffer: named values of the surfels, blended together and divided by alpha once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.splat import Blended, Camera, Shown, splat, splat_shown
from mi_refgs.splat.lanes import Places
from mi_refgs.surfels.table import Surfels

OBJECT = "object"
"""Slot of the object's opacity; where it is blended, slots are divided by it."""


@dataclass(frozen=True)
class GBuffer:
    """Blended slots of a view: arrays of H·W values in raster order. A slot that nobody needs is absent.

    Those of a picture alone are in the order of `places`.
    """

    alpha: Any  # accumulated opacity
    depth: Any  # expected camera-z depth, 0 where nothing is seen; None where it was not asked for
    slots: dict[str, Any]  # premultiplied by alpha, each of the type that was blended
    inverse: Any  # 1/alpha, or 1/object alpha, where that is seen, else 0
    places: Places | None = None

    @staticmethod
    def blend(
        surfels: Surfels,
        slots: Mapping[str, Any],
        camera: Camera,
        screen_offset: Any = None,
        forward_only: bool = False,
        depth: bool = True,
    ) -> GBuffer:
        """Blend values of width N by name: mi.Float, or an array of several such as mi.Color3f.

        Every component is a feature, which costs time in every surfel-tile pair. `screen_offset`: see
        `splat.project`. `forward_only`: no derivatives, and no depth unless `depth`.
        """
        features = [part for value in slots.values() for part in parts(value)]
        blended: Blended | Shown
        if forward_only:
            blended = splat_shown(surfels, features, camera, depth)
        else:
            blended = splat(surfels, features, camera, screen_offset)
        rest, maps = list(blended.features), {}
        for name, value in slots.items():
            width = len(parts(value))
            maps[name], rest = of_parts(value, rest[:width]), rest[width:]
        inverse = inverse_alpha(blended.alpha)
        own = inverse_alpha(maps[OBJECT]) if OBJECT in maps else inverse
        mean_depth = None if blended.depth is None else blended.depth * inverse
        return GBuffer(blended.alpha, mean_depth, maps, own, getattr(blended, "places", None))

    def divided(self, name: str) -> Any:
        """A slot divided by alpha or the object's opacity: the mean of what is seen, 0 where nothing is."""
        value = self.slots[name]
        return of_parts(value, [part * self.inverse for part in parts(value)])


def inverse_alpha(alpha: Any) -> Any:
    """1/A where anything is seen (COVERAGE_FLOOR), else 0, with a finite gradient everywhere."""
    seen = alpha > COVERAGE_FLOOR
    return dr.select(seen, dr.rcp(dr.select(seen, alpha, 1)), 0)


def parts(value: Any) -> list[Any]:
    """The components of a value, mi.Float each."""
    return [*value] if dr.depth_v(value) > 1 else [value]


def of_parts(like: Any, parts: list[Any]) -> Any:
    """The parts as an array of the type of `like`."""
    return type(like)(*parts)
