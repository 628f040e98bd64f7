"""Work of splatting one view, counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.splat import Camera, Footprints, TileLists
from mi_refgs.splat.lanes import advance
from mi_refgs.types import UInt32


@dataclass(frozen=True)
class Counts:
    """Splatting work of one view."""

    surfels: int
    pixels: int
    tile_pixels: int  # per tile
    pairs: int  # surfel-tile pairs listed
    visited: int  # pairs that a tile reached before all of its pixels had ended
    contributing: int  # surfel-pixel pairs with α ≥ ALPHA_MIN, before the pixel's end
    covered: int  # pixels with a contribution
    pixels_of_surfel: UInt32  # (N,) pixels to which a surfel contributes

    @property
    def evaluated(self) -> int:
        """Surfel-pixel evaluations: a visited pair is evaluated at every pixel of its tile at once."""
        return self.visited * self.tile_pixels


def count(footprints: Footprints, lists: TileLists, camera: Camera) -> Counts:
    """Walk the lists as `splat.composite` does, and count; waits for the device."""
    columns = [dr.detach(column) for column in footprints.columns]
    surfels, pixels = dr.width(columns[0]), camera.width * camera.height
    pixels_of_surfel = dr.zeros(mi.UInt32, surfels)
    width, height = camera.tile
    if not lists.pairs:
        return Counts(surfels, pixels, width * height, 0, 0, 0, 0, pixels_of_surfel)
    lane = dr.arange(mi.UInt32, camera.tiles[0] * camera.tiles[1] * width * height)
    tile, local = lane // (width * height), lane % (width * height)
    x = (tile % camera.tiles[0]) * width + local % width - camera.tile_offset[0]
    y = (tile // camera.tiles[0]) * height + local // width - camera.tile_offset[1]
    pixel = mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5)
    begin = dr.gather(mi.UInt32, lists.pair_begin, tile)
    end = dr.gather(mi.UInt32, lists.pair_end, tile)

    def condition(pair: Any, active: Any, transmittance: Any, steps: Any, hits: Any) -> Any:
        return active & (pair < end)

    def body(pair: Any, active: Any, transmittance: Any, steps: Any, hits: Any) -> Any:
        surfel = dr.gather(mi.UInt32, lists.surfel_from_pair, pair, active)
        row = [dr.gather(mi.Float, column, surfel, active) for column in columns]
        sample = footprints.primitive.evaluate(row, pixel, camera.near)
        weight, after, goes_on = advance(sample, active, transmittance)
        hit = weight > 0
        dr.scatter_add(pixels_of_surfel, mi.UInt32(1), surfel, hit)
        return pair + 1, goes_on, after, steps + 1, hits + dr.select(hit, mi.UInt32(1), mi.UInt32(0))

    inside = (x < camera.width) & (y < camera.height)
    state = (begin, inside, mi.Float(1), mi.UInt32(0), mi.UInt32(0))
    _, _, _, steps, hits = dr.while_loop(state, condition, body, label="count")
    dr.eval(steps, hits, pixels_of_surfel)
    # A tile continues until the last of its pixels has ended.
    visited = int(dr.sum(dr.block_reduce(dr.ReduceOp.Max, steps, width * height))[0])
    contributing, covered = int(dr.sum(hits)[0]), int(dr.count(hits > 0)[0])
    counts = surfels, pixels, width * height, lists.pairs, visited, contributing, covered
    return Counts(*counts, pixels_of_surfel)
