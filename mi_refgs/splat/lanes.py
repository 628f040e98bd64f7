"""SIMD lanes over an image, and their common walk along the lists of tiles.

A tile is the smallest area that has a list of surfels. A lane has a square of LANE_PIXELS_PER_AXIS² pixels of
it. Here a tile of 8 × 4 pixels and its 8 lanes a … h:

    a a b b c c d d          A lane keeps the states of its pixels side by side: it reads the row of a surfel,
    a a b b c c d d          and adds to its gradient, once for all of them. With one pixel per lane, that is
    e e f f g g h h          most of the work. A square lane, and a SIMD vector of them, covers a compact area
    e e f f g g h h          even where the vector has fewer lanes than the tile: it ends sooner.

A patch of PATCH_EDGE² pixels, one tile or several, fills a SIMD vector with its lanes (here 2 tiles, one
above the other: 16 lanes). The vector ends with the last pixel of its tiles. Lanes are in the order of
patches, then tiles of the patch, then squares of the tile, each row by row.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import LANE_PIXELS_PER_AXIS, PATCH_EDGE, TRANSMITTANCE_MIN
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.tiles import TileLists
from mi_refgs.surfels.primitives.primitive import FootprintSample
from mi_refgs.types import Bool, Float, Point2f, UInt32

SIDE = LANE_PIXELS_PER_AXIS
LANE_PIXELS = SIDE**2
PATCH_LANES = PATCH_EDGE**2 // LANE_PIXELS


@dataclass(frozen=True)
class Grid:
    """Patches of tiles over an image, row by row; `lanes` per tile and `tiles` per patch along each axis."""

    camera: Camera

    @property
    def lanes(self) -> tuple[int, int]:
        return self.camera.tile[0] // SIDE, self.camera.tile[1] // SIDE

    @property
    def tiles(self) -> tuple[int, int]:
        return PATCH_EDGE // self.camera.tile[0], PATCH_EDGE // self.camera.tile[1]

    @property
    def columns(self) -> int:
        return -(-self.camera.tiles[0] // self.tiles[0])

    @property
    def patches(self) -> int:
        return self.columns * -(-self.camera.tiles[1] // self.tiles[1])


@dataclass(frozen=True)
class Lanes:
    """L lanes and their pixels."""

    pixel: list[Point2f]  # LANE_PIXELS × (L,): centre
    raster: list[UInt32]  # LANE_PIXELS × (L,): index in the image
    inside: list[Bool]  # LANE_PIXELS × (L,): whether it is in the image
    begin: UInt32  # (L,): first pair of the tile
    end: UInt32  # (L,): one past its last pair
    tile: UInt32  # (L,): in the image, where it has pairs

    @staticmethod
    def of(lists: TileLists, chosen: UInt32 | None = None) -> Lanes:
        """The lanes of all patches, or of those `chosen`."""
        camera, grid = lists.camera, Grid(lists.camera)
        (lanes_x, lanes_y), (side_x, side_y), (tiles_x, tiles_y) = grid.lanes, grid.tiles, camera.tiles
        # Patch, tile in the patch, square in the tile.
        count = grid.patches if chosen is None else dr.width(chosen)
        lane = dr.arange(mi.UInt32, count * PATCH_LANES)
        patch, lane = lane // PATCH_LANES, lane % PATCH_LANES
        if chosen is not None:
            patch = dr.gather(mi.UInt32, chosen, patch)
        tile, lane = lane // (lanes_x * lanes_y), lane % (lanes_x * lanes_y)
        tile_x = patch % grid.columns * side_x + tile % side_x
        tile_y = patch // grid.columns * side_y + tile // side_x
        there = (tile_x < tiles_x) & (tile_y < tiles_y)
        tile = tile_y * tiles_x + tile_x
        # Pixels. Those before the image wrap round to huge numbers, and are not inside either.
        corner_x = tile_x * camera.tile[0] + lane % lanes_x * SIDE - camera.tile_offset[0]
        corner_y = tile_y * camera.tile[1] + lane // lanes_x * SIDE - camera.tile_offset[1]
        pixels = [(corner_x + x, corner_y + y) for y in range(SIDE) for x in range(SIDE)]
        return Lanes(
            [mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5) for x, y in pixels],
            [y * camera.width + x for x, y in pixels],
            [there & (x < camera.width) & (y < camera.height) for x, y in pixels],
            dr.gather(mi.UInt32, lists.pair_begin, tile, there),
            dr.gather(mi.UInt32, lists.pair_end, tile, there),
            tile,
        )

    @staticmethod
    def parts(lists: TileLists) -> list[tuple[Lanes, int]]:
        """All lanes, with the number of features that their surfels have: those of patches with a surfel of
        the first table, then the others; waits for the device if rows differ."""
        lanes = Lanes.of(lists)
        if lists.few is None:
            return [(lanes, lists.features)]
        shown = dr.gather(mi.UInt32, lists.with_all, lanes.tile, lanes.begin < lanes.end)
        whole = dr.block_reduce(dr.ReduceOp.Or, shown, PATCH_LANES) > 0
        parts = ((dr.compress(whole), lists.features), (dr.compress(~whole), lists.few))
        return [(Lanes.of(lists, chosen), count) for chosen, count in parts if dr.width(chosen)]

    def each(self, *values: list[Any]) -> Any:
        """Iterate over a lane's pixels: centre, raster index, inside, and lists of a value per pixel."""
        return zip(self.pixel, self.raster, self.inside, *values, strict=True)

    def to_raster(self, images: list[Float], values: list[list[Float]]) -> None:
        """Write values per pixel of the lanes to images, in the kernel of the loop that made them."""
        for _, raster, inside, of_pixel in self.each(values):
            for image, value in zip(images, of_pixel, strict=True):
                dr.scatter(image, value, raster, inside, mode=dr.ReduceMode.NoConflicts)
        dr.eval(images)

    def from_raster(self, images: list[Float]) -> list[list[Float]]:
        """Inverse of `to_raster`; 0 outside the image."""
        return [[dr.gather(mi.Float, x, raster, inside) for x in images] for _, raster, inside in self.each()]


def any_of(flags: list[Bool]) -> Bool:
    """Whether one of several masks is set."""
    return reduce(operator.or_, flags)


def advance(sample: FootprintSample, active: Bool, transmittance: Float) -> tuple[Float, Float, Bool]:
    """Weight of a footprint's sample, the transmittance behind it, and whether the pixel goes on."""
    hit = active & sample.valid
    after = transmittance * (1 - sample.alpha)
    ends = hit & (after < TRANSMITTANCE_MIN)
    hit &= ~ends
    weight = dr.select(hit, transmittance * sample.alpha, 0)
    return weight, dr.select(hit, after, transmittance), active & ~ends


def walk(
    lists: TileLists, lanes: Lanes, step: Callable[..., Any], start: list[tuple[Any, ...]], label: str
) -> list[Any]:
    """Visit the surfels of each lane's tile until its last pixel has ended. `start` is lists of states per
    pixel, first whether it goes on; `step` maps surfel, whether the lane goes on, and states to such."""

    def surfel_at(pair: UInt32, some: Bool) -> UInt32:
        return dr.gather(mi.UInt32, lists.surfel_from_pair, pair, some & (pair < lanes.end))

    def condition(pair: UInt32, surfel: UInt32, active: list[Bool], *state: list[Any]) -> Bool:
        return any_of(active) & (pair < lanes.end)

    def body(pair: UInt32, surfel: UInt32, active: list[Bool], *state: list[Any]) -> Any:
        goes_on = any_of(active)
        # The next surfel is read while this one is worked on: its row waits for nothing then.
        following = surfel_at(pair + 1, goes_on)
        after = step(surfel, goes_on, active, *state)
        return pair + 1, following, *map(list, zip(*after, strict=True))

    begin = (lanes.begin, surfel_at(lanes.begin, True), *map(list, zip(*start, strict=True)))
    _, _, *state = dr.while_loop(begin, condition, body, label=label)
    return state
