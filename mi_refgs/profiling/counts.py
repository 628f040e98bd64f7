"""How much work a view is: surfel-tile pairs listed, evaluations at pixels, and those that contribute."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.splat import Camera, Footprints, TileLists
from mi_refgs.splat.lanes import advance


@dataclass(frozen=True)
class Counts:
    """What the splatter has to do for one view, in numbers of things."""

    surfels: int
    pixels: int
    tile_pixels: int  # of a tile
    pairs: int  # surfel-tile pairs listed
    visited: int  # of these, those that a tile came to before all of its pixels had ended
    contributing: int  # surfel-pixel pairs with α ≥ ALPHA_MIN, before the pixel's end
    covered: int  # pixels with a contribution
    pixels_of_surfel: Any  # mi.UInt32 (N,): at how many pixels a surfel contributes

    @property
    def evaluated(self) -> int:
        """Surfel-pixel evaluations: a visited pair is evaluated at every pixel of its tile at once."""
        return self.visited * self.tile_pixels

    @property
    def share(self) -> float:
        """Share of the evaluated pairs that contribute."""
        return self.contributing / max(self.evaluated, 1)


def count(footprints: Footprints, lists: TileLists, camera: Camera) -> Counts:
    """Walk the lists as `splat.blend` does, and count; waits for the device."""
    columns = [dr.detach(column) for column in footprints.columns]
    surfels = dr.width(columns[0])
    pixels_of_surfel = dr.zeros(mi.UInt32, surfels)
    pixels = camera.width * camera.height
    width, height = camera.tile
    if not lists.pairs:
        return Counts(surfels, pixels, width * height, 0, 0, 0, 0, pixels_of_surfel)
    lane = dr.arange(mi.UInt32, lists.tiles_x * lists.tiles_y * width * height)
    tile, local = lane // (width * height), lane % (width * height)
    x = (tile % lists.tiles_x) * width + local % width - camera.tile_offset[0]
    y = (tile // lists.tiles_x) * height + local // width - camera.tile_offset[1]
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
        hits = hits + dr.select(hit, mi.UInt32(1), mi.UInt32(0))
        return pair + 1, goes_on, after, steps + 1, hits

    inside = (x < camera.width) & (y < camera.height)
    state = (begin, inside, mi.Float(1), mi.UInt32(0), mi.UInt32(0))
    _, _, _, steps, hits = dr.while_loop(state, condition, body, label="count")
    dr.eval(steps, hits, pixels_of_surfel)
    # A tile goes on until the last of its pixels has ended.
    visited = dr.sum(dr.block_reduce(dr.ReduceOp.Max, steps, width * height))
    return Counts(
        surfels=surfels,
        pixels=pixels,
        tile_pixels=width * height,
        pairs=lists.pairs,
        visited=int(visited[0]),
        contributing=int(dr.sum(hits)[0]),
        covered=int(dr.count(hits > 0)[0]),
        pixels_of_surfel=pixels_of_surfel,
    )
