"""Compositing for a picture alone: what `blend` gives, without derivatives and without what nobody asks for.

Alpha is 1 - T at the end and costs nothing; depth is a channel where it is asked for. Packets without any
surfel have no lanes, and the maps are in the order of `Places`, so that what shades them leaves out the empty
part of the picture too, and rays of neighbouring pixels are traced together.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.rows import PackedRows
from mi_refgs.kernels.timing import phase
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.lanes import BLOCKS, PACKET_LANES, Grid, Lanes, Places, advance, walk
from mi_refgs.splat.tiles import TileLists
from mi_refgs.surfels.primitives import Footprints


@dataclass(frozen=True)
class Shown:
    """Blended maps, mi.Float (P,) each, in the order of `places`. Nothing is divided by alpha."""

    features: list[Any]  # K maps Σ w f
    depth: Any  # Σ w z; None where it was not asked for
    alpha: Any  # Σ w
    places: Places | None  # None where nothing is seen: zeros in raster order

    @staticmethod
    def nothing(features: int, camera: Camera, depth: bool) -> Shown:
        """The maps of a view that shows no surfel."""
        blank = [dr.zeros(mi.Float, camera.width * camera.height) for _ in range(features + 1)]
        return Shown(blank[1:], dr.zeros(mi.Float, dr.width(blank[0])) if depth else None, blank[0], None)


@phase("splat forward")
def blend_shown(
    footprints: Footprints, features: list[Any], lists: TileLists, camera: Camera, depth: bool
) -> Shown:
    """Composite per-surfel features (K × mi.Float (N,)) as `blend` does."""
    if not lists.pairs:
        return Shown.nothing(len(features), camera, depth)
    grid = Grid(lists, camera)
    chosen, primitive = grid.filled(), footprints.primitive
    lanes = Lanes.of(grid, chosen)
    rows = PackedRows.pack(footprints.columns + features)
    dr.eval(rows.data)
    maps = len(features) + depth

    def step(surfel: Any, some: Any, active: Any, *state: Any) -> Any:
        row = rows.fetch(surfel, some)
        after = []
        for pixel, _, _, active_here, transmittance, out in lanes.each(active, *state):
            sample = primitive.evaluate(row, pixel, camera.near)
            weight, transmittance_after, goes_on = advance(sample, active_here, transmittance)
            values = [*row[primitive.columns :][: len(features)], sample.z][:maps]
            out = [dr.fma(weight, value, total) for value, total in zip(values, out, strict=True)]
            after.append((goes_on, transmittance_after, out))
        return after

    start = [(mi.Bool(inside), mi.Float(1), [mi.Float(0)] * maps) for inside in lanes.inside]
    _, transmittance, out = walk(lists, lanes, step, start, "blend")
    images = [dr.empty(mi.Float, BLOCKS * dr.width(chosen) * PACKET_LANES) for _ in range(maps + 1)]
    for place, behind, of_block in zip(Places.of_blocks(dr.width(chosen)), transmittance, out, strict=True):
        for image, value in zip(images, [*of_block, 1 - behind], strict=True):
            dr.scatter(image, value, place, mode=dr.ReduceMode.NoConflicts)
    dr.eval(images)
    *images, alpha = images
    return Shown(
        images[: len(features)], images[-1] if depth else None, alpha, Places.of(grid, chosen, lanes)
    )
