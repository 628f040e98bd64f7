"""Which surfels each tile has to look at, nearest first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import TILE
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.footprint import Footprints, depth_near


@dataclass(frozen=True)
class TileLists:
    """M surfel-tile pairs, sorted by tile, then by the surfel's depth there; no derivative."""

    surfel_from_pair: Any  # mi.UInt32 (M,)
    pair_begin: Any  # mi.UInt32 (tiles,): first pair of a tile
    pair_end: Any  # mi.UInt32 (tiles,): one past its last pair
    tiles_x: int
    tiles_y: int

    @property
    def pairs(self) -> int:
        """Number of surfel-tile pairs."""
        return dr.width(self.surfel_from_pair)


def list_by_tile(footprints: Footprints, camera: Camera) -> TileLists:
    """List every surfel in each TILE × TILE pixel tile that its rectangle touches.

    Both sorts are stable, so surfels of equal depth keep the order of the table.
    """
    phase_x, phase_y = camera.phase
    tiles_x, tiles_y = -(-(camera.width + phase_x) // TILE), -(-(camera.height + phase_y) // TILE)
    tiles = tiles_x * tiles_y
    first_x, first_y = ((x + start) // TILE for x, start in zip(footprints.first, camera.phase, strict=True))
    last_x, last_y = ((x + start) // TILE for x, start in zip(footprints.last, camera.phase, strict=True))
    covers = (footprints.last[0] >= footprints.first[0]) & (footprints.last[1] >= footprints.first[1])
    span_x = mi.UInt32(last_x - first_x + 1)
    count = dr.select(covers, span_x * mi.UInt32(last_y - first_y + 1), 0)
    dr.eval(count, span_x, first_x, first_y)

    surfel = dr.repeat(dr.arange(mi.UInt32, dr.width(count)), count)
    if dr.width(surfel) == 0:
        empty = dr.zeros(mi.UInt32, tiles)
        return TileLists(mi.UInt32(), empty, empty, tiles_x, tiles_y)

    first_pair = dr.prefix_reduce(dr.ReduceOp.Add, count, exclusive=True)
    place = dr.arange(mi.UInt32, dr.width(surfel)) - dr.gather(mi.UInt32, first_pair, surfel)
    # The masked lanes that fill up the last packet divide too: dividing an integer by 0 kills the process.
    span = dr.maximum(dr.gather(mi.UInt32, span_x, surfel), 1)
    row = place // span
    tile_x = mi.UInt32(dr.gather(mi.Int32, first_x, surfel)) + place - row * span
    tile_y = mi.UInt32(dr.gather(mi.Int32, first_y, surfel)) + row
    tile = tile_y * tiles_x + tile_x
    centre = TILE * (mi.Point2f(mi.Float(tile_x), mi.Float(tile_y)) + 0.5) - mi.Vector2f(phase_x, phase_y)
    depth = depth_near(footprints, surfel, centre)
    dr.eval(tile, surfel, depth)

    pair_from_rank = dr.argsort(depth)
    order = dr.gather(mi.UInt32, pair_from_rank, dr.argsort(dr.gather(mi.UInt32, tile, pair_from_rank)))
    histogram = dr.zeros(mi.UInt32, tiles)
    dr.scatter_add(histogram, mi.UInt32(1), tile)
    pair_end = dr.prefix_reduce(dr.ReduceOp.Add, histogram, exclusive=False)
    return TileLists(dr.gather(mi.UInt32, surfel, order), pair_end - histogram, pair_end, tiles_x, tiles_y)
