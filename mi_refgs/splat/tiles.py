"""Which surfels each tile has to look at, nearest first."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import TILE
from mi_refgs.rows import Rows
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.footprint import Footprints, depth_near, overlaps


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
    """List every surfel in each tile that its footprint may touch.

    Both sorts are stable, so surfels of equal depth keep the order of the table.
    """
    phase_x, phase_y = camera.phase
    tiles_x, tiles_y = -(-(camera.width + phase_x) // TILE[0]), -(-(camera.height + phase_y) // TILE[1])
    tiles = tiles_x * tiles_y
    surfel, tile_x, tile_y = _rectangles(footprints, camera)
    if dr.width(surfel) == 0:
        return _empty(tiles_x, tiles_y)
    row = Rows.pack(footprints.columns).fetch(surfel)
    tile_size = mi.Vector2f(*TILE)
    corner = tile_size * mi.Point2f(mi.Float(tile_x), mi.Float(tile_y)) - mi.Vector2f(phase_x, phase_y)
    touches = overlaps(row, corner + 0.5, corner + (tile_size - 0.5))  # centres of the outermost pixels
    tile = mi.UInt32(tile_y * tiles_x + tile_x)
    depth = depth_near(row, corner + tile_size / 2)
    dr.eval(touches, tile, surfel, depth)
    kept = dr.compress(touches)
    if dr.width(kept) == 0:
        return _empty(tiles_x, tiles_y)
    tile, surfel, depth = (dr.gather(type(x), x, kept) for x in (tile, surfel, depth))

    nearest_first = dr.argsort(depth)
    tile = dr.gather(mi.UInt32, tile, nearest_first)
    dr.eval(tile)
    # One pass of a counting sort, where `dr.argsort` would make three.
    buckets = 1 << max(tiles - 1, 1).bit_length()
    by_tile = dr.detail.block_mkperm(tile, dr.width(tile), buckets)
    order = dr.gather(mi.UInt32, nearest_first, by_tile)
    histogram = dr.zeros(mi.UInt32, tiles)
    dr.scatter_add(histogram, mi.UInt32(1), tile)
    pair_end = dr.prefix_reduce(dr.ReduceOp.Add, histogram, exclusive=False)
    return TileLists(dr.gather(mi.UInt32, surfel, order), pair_end - histogram, pair_end, tiles_x, tiles_y)


def _empty(tiles_x: int, tiles_y: int) -> TileLists:
    none = dr.zeros(mi.UInt32, tiles_x * tiles_y)
    return TileLists(mi.UInt32(), none, none, tiles_x, tiles_y)


def _rectangles(footprints: Footprints, camera: Camera) -> tuple[Any, Any, Any]:
    """Surfel, tile column and tile row of every tile in the rectangles of footprints, surfel by surfel."""
    first, last = (
        [mi.Int32((x + start) // size) for x, start, size in zip(corner, camera.phase, TILE, strict=True)]
        for corner in (footprints.first, footprints.last)
    )
    covers = (footprints.last[0] >= footprints.first[0]) & (footprints.last[1] >= footprints.first[1])
    span = mi.UInt32(last[0] - first[0] + 1)
    count = dr.select(covers, span * mi.UInt32(last[1] - first[1] + 1), 0)
    end = dr.prefix_reduce(dr.ReduceOp.Add, count, exclusive=False)
    dr.eval(count, span, first, end)
    pairs = int(end[-1])
    if pairs == 0:
        return mi.UInt32(), mi.UInt32(), mi.UInt32()
    # The index of a surfel at its first pair, and up to the next one's by a running maximum: `dr.repeat`
    # searches for every pair instead, and takes 6 times as long.
    surfel = dr.zeros(mi.UInt32, pairs)
    dr.scatter(surfel, dr.arange(mi.UInt32, dr.width(count)), end - count, count > 0)
    surfel = dr.prefix_reduce(dr.ReduceOp.Max, surfel, exclusive=False)
    place = dr.arange(mi.UInt32, pairs) - dr.gather(mi.UInt32, end - count, surfel)
    # The masked lanes that fill up the last packet divide too: dividing an integer by 0 kills the process.
    span = dr.maximum(dr.gather(mi.UInt32, span, surfel), 1)
    row = place // span
    tile_x = mi.UInt32(dr.gather(mi.Int32, first[0], surfel)) + place - row * span
    return surfel, tile_x, mi.UInt32(dr.gather(mi.Int32, first[1], surfel)) + row
