"""Lists of the surfels that each tile may show, nearest first."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.rows import PackedRows
from mi_refgs.kernels.timing import phase
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.primitives.primitive import Footprints, Primitive
from mi_refgs.types import Bool, Float, Int32, UInt32, UInt64

MAX_PAIR_BITS = 27  # log₂ of the largest number of surfel-tile pairs: 40 bytes each, 5 GB in all
DEPTH_BITS = 24  # of the depth by which surfels of a tile are sorted
CHUNK = 1 << 25  # tiles in footprints' rectangles that are tested together: 20 bytes each, 0.7 GB


@dataclass(frozen=True)
class TileLists:
    """M surfel-tile pairs, sorted by tile, then by the surfel's depth there; no derivative."""

    camera: Camera
    primitive: Primitive
    rows: PackedRows  # (N,): columns of the footprints, then features, then turns
    surfel_from_pair: UInt32  # (M,)
    pair_begin: UInt32  # (tiles,): first pair of a tile
    pair_end: UInt32  # (tiles,): one past its last pair
    turned: int = 0  # the first features that vary over their surfel, by two turns each
    few: int | None = None  # features of the rows of tables after the first; the others are zero
    with_all: UInt32 = None  # (tiles,): 1 where a row of the first table is listed, if there are few

    @property
    def pairs(self) -> int:
        """Number of surfel-tile pairs."""
        return dr.width(self.surfel_from_pair)

    @property
    def features(self) -> int:
        """Number of features K."""
        return self.rows.width - self.primitive.columns - 2 * self.turned


@phase("tile lists")
def list_by_tile(
    footprints: Footprints,
    camera: Camera,
    features: Sequence[Float] = (),
    turns: Sequence[Float] = (),
    few: tuple[int, int] | None = None,
) -> TileLists:
    """List every surfel, stably, in each tile that its footprint may touch, and pack footprints, features and
    turns (N,). `few`: a row from which on only so many features are not zero. Raises InputError for more than
    2^MAX_PAIR_BITS pairs."""
    camera = replace(camera, fine=footprints.fine)
    tiles = camera.tiles[0] * camera.tiles[1]
    dr.eval(footprints.columns, footprints.first, footprints.last)  # else each kernel below projects anew
    rows, turned = PackedRows.pack([*footprints.columns, *features, *turns]), len(turns) // 2
    tile_size, primitive = mi.Vector2f(*camera.tile), footprints.primitive
    found: list[list[Any]] = []  # tiles, surfels and depths of pairs, part by part
    count = 0
    for surfel, tile_x, tile_y in _candidates(footprints, camera):
        row = rows.fetch(surfel)
        corner = tile_size * mi.Point2f(mi.Float(tile_x), mi.Float(tile_y)) - mi.Vector2f(*camera.tile_offset)
        # Between the centres of the outermost pixels.
        overlaps = primitive.overlaps(row, corner + 0.5, corner + (tile_size - 0.5))
        depth = primitive.depth_near(row, corner + tile_size / 2)
        pairs = [mi.UInt32(tile_y * camera.tiles[0] + tile_x), surfel, depth]
        # Those that overlap are scattered: to gather them by `dr.compress` takes four times as long.
        place = dr.prefix_reduce(dr.ReduceOp.Add, mi.UInt32(overlaps), exclusive=False)
        dr.eval(overlaps, pairs, place)
        kept = int(place[-1])
        count += kept
        if count > 1 << MAX_PAIR_BITS:
            size = f"{tiles:,} tiles of {camera.width} × {camera.height} pixels"
            remedy = "render fewer pixels, or remove the largest surfels"
            what = f"more than {1 << MAX_PAIR_BITS:,} surfels on the {size}"
            raise InputError(what, "splat", "surfels", remedy)
        if kept:
            found.append([dr.empty(type(values), kept) for values in pairs])
            for part, values in zip(found[-1], pairs, strict=True):
                dr.scatter(part, values, place - 1, overlaps, mode=dr.ReduceMode.NoConflicts)
            dr.eval(found[-1])
    if not found:
        none = dr.zeros(mi.UInt32, tiles)
        return TileLists(camera, primitive, rows, mi.UInt32(), none, none, turned)
    every = found[0] if len(found) == 1 else [dr.concat(list(x)) for x in zip(*found, strict=True)]
    tile, surfel = _sorted(every[0], every[1], every[2], rows.count, tiles)
    lists = TileLists(camera, primitive, rows, surfel, *_runs(tile, tiles), turned)
    if few is None or few[1] >= len(features):
        return lists
    with_all = dr.zeros(mi.UInt32, tiles)
    dr.scatter(with_all, mi.UInt32(1), tile, surfel < dr.opaque(mi.UInt32, few[0]))
    return replace(lists, few=few[1], with_all=with_all)


@phase("sort")
def _sorted(tile: UInt32, surfel: UInt32, depth: Float, surfels: int, tiles: int) -> tuple[UInt32, UInt32]:
    """Tiles and surfels of pairs, sorted by tile, then by depth: a stable radix sort of one integer of all
    three, in three passes. Bits of positive floats are in their order; the last digits drop if the
    largest depth is more than four times the smallest."""
    high = max((tiles - 1).bit_length(), 1)
    low = max((surfels - 1).bit_length(), 64 - DEPTH_BITS - high)  # the same for most numbers of surfels
    middle = 64 - low - high
    key = dr.reinterpret_array(mi.UInt32, depth)
    dr.eval(key)
    least = dr.min(key)
    spare = 32 - middle
    key = (key - least) >> (spare - dr.minimum(dr.lzcnt(dr.max(key) - least), spare))
    joined = (mi.UInt64(tile) << middle | mi.UInt64(key)) << low | mi.UInt64(surfel)
    half = middle // 2
    for shift, bits in ((low, half), (low + half, middle - half), (low + middle, high)):
        digit = mi.UInt32(joined >> shift) & ((1 << bits) - 1)
        dr.eval(joined, digit)
        joined = dr.gather(mi.UInt64, joined, dr.detail.block_mkperm(digit, dr.width(digit), 1 << bits))
    tile, surfel = mi.UInt32(joined >> (low + middle)), mi.UInt32(joined & ((1 << low) - 1))
    dr.eval(tile, surfel)
    return tile, surfel


def _runs(tile: UInt32, tiles: int) -> tuple[UInt32, UInt32]:
    """First pair (tiles,), and one past the last pair (tiles,), of each tile among sorted tiles (M,)."""
    pairs, wanted = dr.opaque(mi.UInt32, dr.width(tile)), dr.arange(mi.UInt32, tiles + 1)

    def before(place: UInt32) -> Bool:
        inside = place < pairs
        return inside & (dr.gather(mi.UInt32, tile, place, inside) < wanted)

    # The same number of steps for every number of pairs, or each would compile a kernel.
    edges = mi.UInt32(dr.binary_search(0, 1 << MAX_PAIR_BITS, before))
    dr.eval(edges)
    first = dr.arange(mi.UInt32, tiles)
    return dr.gather(mi.UInt32, edges, first), dr.gather(mi.UInt32, edges, first + 1)


def _candidates(footprints: Footprints, camera: Camera) -> Iterator[tuple[UInt32, UInt32, UInt32]]:
    """Yield surfel, tile column and tile row of every tile in footprints' rectangles, CHUNK by CHUNK."""
    axes = range(2)
    first = [mi.Int32((footprints.first[k] + camera.tile_offset[k]) // camera.tile[k]) for k in axes]
    last = [mi.Int32((footprints.last[k] + camera.tile_offset[k]) // camera.tile[k]) for k in axes]
    covers = (footprints.last[0] >= footprints.first[0]) & (footprints.last[1] >= footprints.first[1])
    span = mi.UInt32(last[0] - first[0] + 1)
    count = dr.select(covers, span * mi.UInt32(last[1] - first[1] + 1), 0)
    # 65,536 surfels on as many tiles are more than 32 bits count.
    end = dr.prefix_reduce(dr.ReduceOp.Add, mi.UInt64(count), exclusive=False)
    dr.eval(count, span, first, end)
    total = int(end[-1])
    if total == 0:
        return
    cuts = [0, total]
    if total > CHUNK:
        ends = end.numpy()
        inner = ends[np.searchsorted(ends, np.arange(CHUNK, total, CHUNK, dtype=np.uint64))]
        cuts = sorted({*cuts, *inner.tolist()})
    for begin, stop in itertools.pairwise(cuts):
        yield _part(first, span, count, end, begin, stop)


def _part(
    first: list[Int32], span: UInt32, count: UInt32, end: UInt64, begin: int, stop: int
) -> tuple[UInt32, UInt32, UInt32]:
    """Candidates `begin` to `stop`, of whole surfels; each has `count`, and `end` with all before it."""
    pairs, offset = stop - begin, dr.opaque(mi.UInt64, begin)
    start = end - count - offset  # before the part it wraps round, to numbers outside the part too
    inside = (count > 0) & (start < dr.opaque(mi.UInt64, pairs))
    start = mi.UInt32(start)
    # The index of a surfel at its first pair, and up to the next one's by a running maximum: `dr.repeat`
    # searches for every pair instead, and takes 6 times as long.
    surfel = dr.zeros(mi.UInt32, pairs)
    dr.scatter(surfel, dr.arange(mi.UInt32, dr.width(count)), start, inside)
    surfel = dr.prefix_reduce(dr.ReduceOp.Max, surfel, exclusive=False)
    # In one access for each surfel: four gathers take ten times as long.
    packed = PackedRows.pack(_bits(mi.Float, (start, span, *first)), 4)
    start, span, left, top = _bits(mi.UInt32, packed.fetch(surfel))
    place = dr.arange(mi.UInt32, pairs) - start
    # Exact below four million tiles, and in one instruction; integers are divided lane by lane.
    row = mi.UInt32((mi.Float(place) + 0.5) / mi.Float(span))
    return surfel, left + place - row * span, top + row


def _bits(kind: type[Any], values: Iterable[Any]) -> list[Any]:
    """The same bits as numbers of another type."""
    return [dr.reinterpret_array(kind, value) for value in values]
