"""What pictures without alpha show around and behind the object, splatted together with it.

The rows of both tables go through one sort: the object's first, then those of the surroundings. A slot that
only one of the two has is zero in the rows of the other.
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
from mi_refgs.render.gbuffer import of_parts, parts
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import LOGIT_LIMIT, Surfels

AROUND = "surroundings"
"""Slot of the radiance of the surroundings."""


@dataclass(frozen=True)
class Surroundings:
    """Surfels of the object's primitive with radiance_sh and nothing else, and what lies behind everything.

    The background is looked up by the direction of a pixel's ray; without one it is black.
    """

    surfels: Surfels
    background: EnvironmentLight | None = None

    @staticmethod
    def read(ply: str | Path, background: str | Path | None) -> Surroundings:
        """From the files of a run; raises InputError for one that cannot be used."""
        light = None if background is None else EnvironmentLight.from_file(Path(background))
        return Surroundings(read_ply(ply), light)

    def check(self, surfels: Surfels) -> None:
        """Raise InputError unless these can surround an object's surfels."""
        if not self.surfels.has("radiance_sh"):
            raise InputError("surroundings: radiance_sh: the surfels have no such channel; add it")
        if self.surfels.primitive is not surfels.primitive:
            raise InputError(
                "surroundings: scale: not the primitive of the object; give both the same columns"
            )

    def behind(self, camera: Camera) -> Any:
        """Radiance (mi.Color3f) of the background at the pixels of a camera, in raster order, under AD."""
        if self.background is None:
            return dr.zeros(mi.Color3f, camera.width * camera.height)
        return self.background.unfiltered().radiance(dr.normalize(camera.rays()))


def nothing_around(surfels: Surfels) -> Surfels:
    """A table without rows, for an object that has a background alone."""
    widths = {**surfels.primitive.widths, "radiance_sh": 3}
    return Surfels({name: dr.zeros(mi.TensorXf, (0, width)) for name, width in widths.items()})


def together(first: Surfels, second: Surfels) -> Surfels:
    """One table of the geometry of two of one primitive, under AD: the rows of `first`, then of `second`."""
    names, rows = list(first.primitive.widths), first.count + second.count
    arrays = joined([_flat(first, name) for name in names], [_flat(second, name) for name in names])
    return Surfels(
        {
            name: mi.TensorXf(array, shape=(rows, first.raw[name].shape[1]))
            for name, array in zip(names, arrays, strict=True)
        }
    )


def _flat(surfels: Surfels, name: str) -> Any:
    """Raw values, of opacity those of nothing where a `screened` table has rows that are not usable."""
    values = surfels.raw[name].array
    if not surfels.screened or name != "opacity":
        return values
    return dr.select(surfels.usable(), values, -LOGIT_LIMIT)


def joined_slots(
    first: Mapping[str, Any], second: Mapping[str, Any], rows: tuple[int, int]
) -> dict[str, Any]:
    """Named values of two tables of so many rows, one after the other, under AD; zero where one has none."""
    kinds = {**second, **first}
    columns: tuple[list[Any], list[Any]] = ([], [])
    for name, kind in kinds.items():
        for table, count, column in zip((first, second), rows, columns, strict=True):
            found = parts(table[name]) if name in table else [mi.Float(0)] * len(parts(kind))
            column += [x if dr.width(x) == count else x + dr.zeros(mi.Float, count) for x in found]
    rest, slots = joined(*columns), {}
    for name, kind in kinds.items():
        width = len(parts(kind))
        slots[name], rest = of_parts(kind, rest[:width]), rest[width:]
    return slots
