"""Surroundings of the object in images without alpha, splatted together with it in one sort.

The object's surfels come first. A slot that only one of the two has is zero in the surfels of the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.kernels.rows import joined
from mi_refgs.render.gbuffer import parts
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import LOGIT_LIMIT, Surfels
from mi_refgs.types import Color3f, Float

AROUND = "surroundings"
"""Slot of the radiance of the surroundings."""


@dataclass(frozen=True)
class Surroundings:
    """Surfels of the object's primitive with geometry and radiance_sh only, and a distant background.

    The background is looked up in the direction of each pixel's ray; without one it is black.
    """

    surfels: Surfels
    background: EnvironmentLight | None = None

    @staticmethod
    def read(ply: str | Path, background: str | Path | None) -> Surroundings:
        """Read the files of a run; raises InputError for one that cannot be used."""
        light = None if background is None else EnvironmentLight.from_file(Path(background))
        return Surroundings(read_ply(ply), light)

    def check(self, surfels: Surfels) -> None:
        """Raise InputError unless these fit an object's surfels."""
        if not self.surfels.has("radiance_sh"):
            raise InputError("surroundings: radiance_sh: the surfels have no such attribute; add it")
        if self.surfels.primitive is not surfels.primitive:
            raise InputError(
                "surroundings: scale: not the primitive of the object; give both as many columns"
            )

    def behind(self, camera: Camera) -> Color3f:
        """Radiance of the background per pixel of a camera, in raster order, under AD."""
        if self.background is None:
            return dr.zeros(mi.Color3f, camera.width * camera.height)
        return self.background.unfiltered().radiance(dr.normalize(camera.rays()))


def nothing_around(surfels: Surfels) -> Surfels:
    """No surfels of the same primitive, for an object with a background only."""
    widths = {**surfels.primitive.widths, "radiance_sh": 3}
    return Surfels({name: dr.zeros(mi.TensorXf, (0, width)) for name, width in widths.items()})


def together(first: Surfels, second: Surfels) -> Surfels:
    """Geometry of surfels of one primitive, under AD: those of `first`, then those of `second`."""
    names, rows = list(first.primitive.widths), first.count + second.count
    arrays = joined([_flat(first, name) for name in names], [_flat(second, name) for name in names])
    shapes = [(rows, first.raw[name].shape[1]) for name in names]
    raw = {name: mi.TensorXf(x, shape=s) for name, x, s in zip(names, arrays, shapes, strict=True)}
    return Surfels(raw)


def _flat(surfels: Surfels, name: str) -> Float:
    """Raw values; opacity is that of nothing where surfels are `screened` and not usable."""
    values = surfels.raw[name].array
    if not surfels.screened or name != "opacity":
        return values
    return dr.select(surfels.usable(), values, -LOGIT_LIMIT)


def joined_slots(
    first: Mapping[str, Any], second: Mapping[str, Any], rows: tuple[int, int]
) -> dict[str, Any]:
    """Named values of two surfel models of so many surfels, joined under AD; zero where one has none."""
    kinds = {**second, **first}
    columns: tuple[list[Any], list[Any]] = ([], [])
    for name, kind in kinds.items():
        for values, count, column in zip((first, second), rows, columns, strict=True):
            found = parts(values[name]) if name in values else [mi.Float(0)] * len(parts(kind))
            column += [x if dr.width(x) == count else x + dr.zeros(mi.Float, count) for x in found]
    rest, slots = joined(*columns), {}
    for name, kind in kinds.items():
        width = len(parts(kind))
        slots[name], rest = type(kind)(*rest[:width]), rest[width:]
    return slots
