"""How SIMD lanes cover a picture, and their common walk along the lists of tiles.

A packet works on a few tiles, and the lanes of a tile on one surfel at a time; each has one pixel in every
block of its tile and keeps their states side by side. Reading a row and adding to its gradient, most of the
work with one pixel a lane, are then shared.
"""

from __future__ import annotations

import operator
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import LANE_PIXELS_PER_AXIS, PACKET_EDGE, TRANSMITTANCE_MIN
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.tiles import TileLists

BLOCKS = LANE_PIXELS_PER_AXIS**2
"""Pixels of a lane."""
PACKET_LANES = PACKET_EDGE**2 // BLOCKS
"""Lanes of a packet."""
NOWHERE = 0xFFFFFFFF
"""Slot of a packet that was not chosen."""


@dataclass(frozen=True)
class Grid:
    """Packets of tiles over a picture, row by row."""

    lists: TileLists
    camera: Camera

    @property
    def lanes(self) -> tuple[int, int]:
        """Lanes of a tile along each axis, as many as pixels of a block."""
        return self.camera.tile[0] // LANE_PIXELS_PER_AXIS, self.camera.tile[1] // LANE_PIXELS_PER_AXIS

    @property
    def side(self) -> tuple[int, int]:
        """Tiles of a packet along each axis."""
        return PACKET_EDGE // self.camera.tile[0], PACKET_EDGE // self.camera.tile[1]

    @property
    def across(self) -> int:
        """Packets in a row."""
        return -(-self.lists.tiles_x // self.side[0])

    @property
    def packets(self) -> int:
        """Number of packets."""
        return self.across * -(-self.lists.tiles_y // self.side[1])

    def filled(self) -> Any:
        """The packets (mi.UInt32) with a tile that has a list; waits for the device."""
        lanes = Lanes.of(self)
        listed = dr.block_reduce(
            dr.ReduceOp.Or, dr.select(lanes.begin < lanes.end, mi.UInt32(1), 0), PACKET_LANES
        )
        return dr.compress(listed > 0)


@dataclass(frozen=True)
class Lanes:
    """Lanes, packet by packet of tiles, and their pixel in each block of the tile."""

    pixel: list[Any]  # mi.Point2f: centre
    raster: list[Any]  # mi.UInt32: index in the image
    inside: list[Any]  # mi.Bool: is it inside the image?
    begin: Any  # first pair of the tile
    end: Any  # one past its last pair

    @staticmethod
    def of(grid: Grid, chosen: Any = None) -> Lanes:
        """The lanes of all packets, or of those `chosen` (mi.UInt32)."""
        camera, lists, (lanes_x, lanes_y), (side_x, side_y) = grid.camera, grid.lists, grid.lanes, grid.side
        count = grid.packets if chosen is None else dr.width(chosen)
        lane = dr.arange(mi.UInt32, count * PACKET_LANES)
        packet, lane = lane // PACKET_LANES, lane % PACKET_LANES
        if chosen is not None:
            packet = dr.gather(mi.UInt32, chosen, packet)
        tile, lane = lane // (lanes_x * lanes_y), lane % (lanes_x * lanes_y)
        tile_x = packet % grid.across * side_x + tile % side_x
        tile_y = packet // grid.across * side_y + tile // side_x
        there = (tile_x < lists.tiles_x) & (tile_y < lists.tiles_y)
        tile = tile_y * lists.tiles_x + tile_x
        # Pixels before the image wrap round to huge numbers, and are not inside either.
        corner_x = tile_x * camera.tile[0] + lane % lanes_x - camera.tile_offset[0]
        corner_y = tile_y * camera.tile[1] + lane // lanes_x - camera.tile_offset[1]
        blocks = range(LANE_PIXELS_PER_AXIS)
        places = [(corner_x + x * lanes_x, corner_y + y * lanes_y) for y in blocks for x in blocks]
        return Lanes(
            [mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5) for x, y in places],
            [y * camera.width + x for x, y in places],
            [there & (x < camera.width) & (y < camera.height) for x, y in places],
            dr.gather(mi.UInt32, lists.pair_begin, tile, there),
            dr.gather(mi.UInt32, lists.pair_end, tile, there),
        )

    def each(self, *values: list[Any]) -> Any:
        """Pixel, raster index and inside, with anything else that there is one of for each block."""
        return zip(self.pixel, self.raster, self.inside, *values, strict=True)

    def to_raster(self, camera: Camera, values: list[list[Any]]) -> list[Any]:
        """Values of each block to raster images, in the kernel of the loop that made them."""
        images = [dr.empty(mi.Float, camera.width * camera.height) for _ in values[0]]
        for _, raster, inside, of_block in self.each(values):
            for image, value in zip(images, of_block, strict=True):
                dr.scatter(image, value, raster, inside, mode=dr.ReduceMode.NoConflicts)
        dr.eval(images)
        return images

    def from_raster(self, images: list[Any]) -> list[list[Any]]:
        """Inverse of `to_raster`; 0 outside the image."""
        return [[dr.gather(mi.Float, x, raster, inside) for x in images] for _, raster, inside in self.each()]


@dataclass(frozen=True)
class Places:
    """The P pixels of the packets in which there is something, in an order of their own.

    Packet by packet and block by block: what a SIMD packet reads is a square of the picture, not a line, and
    pixels of which nothing is known but that they are empty have no place.
    """

    raster: Any  # mi.UInt32 (P,): index in the image
    place: Any  # mi.UInt32 (H·W,): where each pixel is
    there: Any  # mi.Bool (H·W,): whether it is anywhere

    @staticmethod
    def of(grid: Grid, chosen: Any, lanes: Lanes) -> Places:
        """Those of the `chosen` packets, whose lanes these are."""
        camera, (lanes_x, lanes_y) = grid.camera, grid.lanes
        raster = dr.empty(mi.UInt32, BLOCKS * dr.width(chosen) * PACKET_LANES)
        for place, index in zip(Places.of_blocks(dr.width(chosen)), lanes.raster, strict=True):
            dr.scatter(raster, index, place, mode=dr.ReduceMode.NoConflicts)
        slot = dr.full(mi.UInt32, NOWHERE, grid.packets)
        dr.scatter(slot, dr.arange(mi.UInt32, dr.width(chosen)), chosen, mode=dr.ReduceMode.NoConflicts)
        dr.eval(raster, slot)

        pixel = dr.arange(mi.UInt32, camera.width * camera.height)
        x, y = pixel % camera.width + camera.tile_offset[0], pixel // camera.width + camera.tile_offset[1]
        slot = dr.gather(mi.UInt32, slot, y // PACKET_EDGE * grid.across + x // PACKET_EDGE)
        x, y = x % PACKET_EDGE, y % PACKET_EDGE
        tile = y // camera.tile[1] * grid.side[0] + x // camera.tile[0]
        x, y = x % camera.tile[0], y % camera.tile[1]
        block = y // lanes_y * LANE_PIXELS_PER_AXIS + x // lanes_x
        lane = tile * (lanes_x * lanes_y) + y % lanes_y * lanes_x + x % lanes_x
        return Places(raster, (slot * BLOCKS + block) * PACKET_LANES + lane, slot != NOWHERE)

    @staticmethod
    def of_blocks(packets: int) -> list[Any]:
        """The place (mi.UInt32) that each block of the lanes of so many packets has."""
        lane = dr.arange(mi.UInt32, packets * PACKET_LANES)
        first = lane // PACKET_LANES * (BLOCKS * PACKET_LANES) + lane % PACKET_LANES
        return [first + block * PACKET_LANES for block in range(BLOCKS)]

    def to_raster(self, value: Any) -> Any:
        """Evaluated values of P places as ones of H·W pixels, 0 where there is nothing; constants stay."""
        if value is None or dr.width(value) == 1:
            return value
        return dr.gather(type(value), value, self.place, self.there)


def any_of(flags: list[Any]) -> Any:
    """Whether one of several masks is set."""
    return reduce(operator.or_, flags)


def advance(sample: Any, active: Any, transmittance: Any) -> tuple[Any, Any, Any]:
    """Does this surfel contribute, with which weight, and does the pixel go on?"""
    hit = active & sample.valid
    after = transmittance * (1 - sample.alpha)
    ends = hit & (after < TRANSMITTANCE_MIN)
    hit &= ~ends
    weight = dr.select(hit, transmittance * sample.alpha, 0)
    return weight, dr.select(hit, after, transmittance), active & ~ends


def walk(lists: TileLists, lanes: Lanes, step: Any, start: list[tuple[Any, ...]], label: str) -> list[Any]:
    """Take every surfel of its tile's list to each lane, until the lane's last pixel has ended.

    `start` is the state of each block, first whether its pixel goes on; `step` maps a surfel, whether the
    lane goes on, and the blocks' states (a list a quantity) to states in the form of `start`. Returns the
    last states, a list a quantity.
    """

    def surfel_at(pair: Any, some: Any) -> Any:
        return dr.gather(mi.UInt32, lists.surfel_from_pair, pair, some & (pair < lanes.end))

    def condition(pair: Any, surfel: Any, active: Any, *state: Any) -> Any:
        return any_of(active) & (pair < lanes.end)

    def body(pair: Any, surfel: Any, active: Any, *state: Any) -> Any:
        goes_on = any_of(active)
        # The next surfel is read while this one is worked on: its row waits for nothing then.
        following = surfel_at(pair + 1, goes_on)
        return pair + 1, following, *_transposed(step(surfel, goes_on, active, *state))

    begin = (lanes.begin, surfel_at(lanes.begin, True), *_transposed(start))
    _, _, *state = dr.while_loop(begin, condition, body, label=label)
    return state


def _transposed(rows: list[tuple[Any, ...]]) -> tuple[list[Any], ...]:
    """One tuple a block to one list a quantity."""
    return tuple(list(column) for column in zip(*rows, strict=True))
