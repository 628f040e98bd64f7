"""Front-to-back compositing of K channels, its adjoint and its tangent: three traced loops over tile lists.

    out_k = Σᵢ wᵢ f_ik,    wᵢ = αᵢ Tᵢ,    Tᵢ = Π_{j<i} (1 - αⱼ)                             [2DGS, eq. 12]

Depth and accumulated alpha are two more channels (f = z and f = 1). The adjoint replays the same order; with
gᵢ = Σ_k δ_k f_ik and S = Σ_k δ_k out_k, which is diminished by wᵢ gᵢ at each step so that it always holds
what lies behind,

    δf_ik = wᵢ δ_k,        δαᵢ = Tᵢ gᵢ - S_{j>i} / (1 - αᵢ)

needs neither a reversed list nor storage per pair. One tile is one SIMD packet, so its lanes read the same
rows.

No derivative, on purpose: the sort order, the tile lists, the α < 1/255 cut and the end at T < 1e-4, the near
plane, the clamp at α_max (zero), the median depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import MEDIAN_TRANSMITTANCE, TILE, TRANSMITTANCE_MIN
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.footprint import (
    GEOMETRY_COLUMNS,
    Footprints,
    evaluate,
    evaluate_backward,
    evaluate_forward,
)
from mi_refgs.splat.tiles import TileLists


@dataclass(frozen=True)
class Blended:
    """Blended maps, each a mi.Float (H·W,) in raster order. Nothing is divided by alpha."""

    features: list[Any]  # K maps Σ w f
    depth: Any  # Σ w z
    alpha: Any  # Σ w
    median_depth: Any  # depth of the last surfel met while T > ½; 0 where there is none; detached


def blend(footprints: Footprints, features: list[Any], lists: TileLists, camera: Camera) -> Blended:
    """Composite per-surfel features (K × mi.Float (N,)); differentiable in features and footprint columns."""
    out = dr.custom(_Blend, footprints.columns + features, lists, camera)
    return Blended(out[: len(features)], out[-3], out[-2], dr.detach(out[-1]))


class _Blend(dr.CustomOp):
    """columns (N-wide) → [features…, depth, alpha, median depth] (pixel-wide)."""

    def eval(self, columns: list[Any], lists: TileLists, camera: Camera) -> list[Any]:
        self.columns, self.lists, self.camera = len(columns), lists, camera
        self.surfels = dr.width(columns[0])
        self.width = 1 << (self.columns - 1).bit_length()  # packet accesses want a power of two
        self.rows = self._pack(columns)
        self.out = _blend_primal(self) if lists.pairs else self._blank()
        return self.out

    def forward(self) -> None:
        if not self.lists.pairs:
            self.set_grad_out(self._blank())
            return
        tangents = _blend_forward(self, self._pack(self.grad_in("columns")))
        self.set_grad_out([*tangents, dr.zeros(mi.Float, dr.width(self.out[-1]))])

    def backward(self) -> None:
        if not self.lists.pairs:  # Dr.Jit refuses to gather from an empty list, even fully masked
            return
        δrows = _blend_backward(self, self.grad_out()[:-1])
        base = dr.arange(mi.UInt32, self.surfels) * self.width
        self.set_grad_in("columns", [dr.gather(mi.Float, δrows, base + i) for i in range(self.columns)])

    def name(self) -> str:
        return "blend"

    def _blank(self) -> list[Any]:
        maps = self.columns - GEOMETRY_COLUMNS + 3
        return [dr.zeros(mi.Float, self.camera.width * self.camera.height) for _ in range(maps)]

    def _pack(self, columns: list[Any]) -> Any:
        """Columns to rows of `width` floats, so that one surfel is one packet access."""
        rows = dr.zeros(mi.Float, self.surfels * self.width)
        padding = [mi.Float(0)] * (self.width - self.columns)
        packet = mi.ArrayXf([dr.detach(column) for column in columns] + padding)
        dr.scatter(rows, packet, dr.arange(mi.UInt32, self.surfels))
        dr.eval(rows)
        return rows


def _lanes(op: _Blend) -> tuple[Any, Any, Any, Any, Any]:
    """Tile-major lanes: pixel centre, raster index, inside the image, first and one-past-last pair."""
    lists, camera = op.lists, op.camera
    lane = dr.arange(mi.UInt32, lists.tiles_x * lists.tiles_y * TILE * TILE)
    tile, local = lane // (TILE * TILE), lane % (TILE * TILE)
    # Pixels before the image wrap round to huge numbers, and are not inside either.
    x = (tile % lists.tiles_x) * TILE + local % TILE - camera.phase[0]
    y = (tile // lists.tiles_x) * TILE + local // TILE - camera.phase[1]
    inside = (x < camera.width) & (y < camera.height)
    begin = dr.gather(mi.UInt32, lists.pair_begin, tile)
    end = dr.gather(mi.UInt32, lists.pair_end, tile)
    return mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5), y * camera.width + x, inside, begin, end


def _fetch(op: _Blend, rows: Any, surfel: Any, active: Any) -> Any:
    return dr.gather(mi.ArrayXf, rows, surfel, active, shape=(op.width, dr.width(surfel)))


def _next(sample: Any, active: Any, transmittance: Any) -> tuple[Any, Any, Any]:
    """Does this surfel contribute, with which weight, and does the pixel go on?"""
    hit = active & sample.valid
    after = transmittance * (1 - sample.alpha)
    ends = hit & (after < TRANSMITTANCE_MIN)
    hit &= ~ends
    weight = dr.select(hit, transmittance * sample.alpha, 0)
    return weight, dr.select(hit, after, transmittance), active & ~ends


def _to_raster(op: _Blend, values: list[Any], raster: Any, inside: Any) -> list[Any]:
    """Tile-major lanes to raster images, in the kernel of the loop that made them."""
    images = [dr.empty(mi.Float, op.camera.width * op.camera.height) for _ in values]
    for image, value in zip(images, values, strict=True):
        dr.scatter(image, value, raster, inside, mode=dr.ReduceMode.NoConflicts)
    dr.eval(images)
    return images


def _values(op: _Blend, row: Any, z: Any) -> list[Any]:
    """What a surfel adds to each map: its features, its depth, and 1 for alpha."""
    return [row[i] for i in range(GEOMETRY_COLUMNS, op.columns)] + [z, mi.Float(1)]


def _blend_primal(op: _Blend) -> list[Any]:
    pixel, raster, inside, begin, end = _lanes(op)
    near = op.camera.near
    maps = op.columns - GEOMETRY_COLUMNS + 2

    def condition(pair: Any, active: Any, transmittance: Any, median: Any, out: Any) -> Any:
        return active & (pair < end)

    def body(pair: Any, active: Any, transmittance: Any, median: Any, out: Any) -> Any:
        surfel = dr.gather(mi.UInt32, op.lists.surfel_from_pair, pair, active)
        row = _fetch(op, op.rows, surfel, active)
        sample = evaluate(row, pixel, near)
        weight, after, goes_on = _next(sample, active, transmittance)
        median = dr.select((weight > 0) & (transmittance > MEDIAN_TRANSMITTANCE), sample.z, median)
        out = [total + weight * value for total, value in zip(out, _values(op, row, sample.z), strict=True)]
        return pair + 1, goes_on, after, median, out

    state = (begin, mi.Bool(inside), mi.Float(1), mi.Float(0), [mi.Float(0) for _ in range(maps)])
    _, _, _, median, out = dr.while_loop(state, condition, body, label="blend")
    return _to_raster(op, [*out, median], raster, inside)


def _blend_backward(op: _Blend, δout: list[Any]) -> Any:
    pixel, raster, inside, begin, end = _lanes(op)
    near = op.camera.near
    δ = [dr.gather(mi.Float, x, raster, inside) for x in δout]
    behind = mi.Float(0)
    for adjoint, total in zip(δ, op.out, strict=False):
        behind += adjoint * dr.gather(mi.Float, total, raster, inside)
    δrows = dr.zeros(mi.Float, op.surfels * op.width)

    def condition(pair: Any, active: Any, transmittance: Any, behind: Any) -> Any:
        return active & (pair < end)

    def body(pair: Any, active: Any, transmittance: Any, behind: Any) -> Any:
        surfel = dr.gather(mi.UInt32, op.lists.surfel_from_pair, pair, active)
        row = _fetch(op, op.rows, surfel, active)
        sample = evaluate(row, pixel, near)
        weight, after, goes_on = _next(sample, active, transmittance)
        hit = weight > 0
        g = mi.Float(0)
        for adjoint, value in zip(δ, _values(op, row, sample.z), strict=True):
            g += adjoint * value
        behind = behind - weight * g
        δalpha = dr.select(hit, transmittance * g - behind / (1 - sample.alpha), 0)
        δgeometry = evaluate_backward(row, sample, δalpha, weight * δ[-2])
        δrow = δgeometry + [weight * adjoint for adjoint in δ[:-2]] + [mi.Float(0)] * (op.width - op.columns)
        dr.scatter_add(δrows, mi.ArrayXf(δrow), surfel, hit)
        return pair + 1, goes_on, after, behind

    dr.while_loop((begin, mi.Bool(inside), mi.Float(1), behind), condition, body, label="blend_backward")
    dr.eval(δrows)
    return δrows


def _blend_forward(op: _Blend, drows: Any) -> list[Any]:
    pixel, raster, inside, begin, end = _lanes(op)
    near = op.camera.near
    maps = op.columns - GEOMETRY_COLUMNS + 2

    def condition(pair: Any, active: Any, transmittance: Any, dtransmittance: Any, dout: Any) -> Any:
        return active & (pair < end)

    def body(pair: Any, active: Any, transmittance: Any, dtransmittance: Any, dout: Any) -> Any:
        surfel = dr.gather(mi.UInt32, op.lists.surfel_from_pair, pair, active)
        row, drow = _fetch(op, op.rows, surfel, active), _fetch(op, drows, surfel, active)
        sample = evaluate(row, pixel, near)
        weight, after, goes_on = _next(sample, active, transmittance)
        hit = weight > 0
        dalpha, dz = evaluate_forward(row, sample, drow)
        dweight = dr.select(hit, dtransmittance * sample.alpha + transmittance * dalpha, 0)
        dvalues = [drow[i] for i in range(GEOMETRY_COLUMNS, op.columns)] + [dz, mi.Float(0)]
        values = _values(op, row, sample.z)
        dout = [
            total + dweight * value + dr.select(hit, weight * dvalue, 0)
            for total, value, dvalue in zip(dout, values, dvalues, strict=True)
        ]
        dtransmittance = dr.select(
            hit, dtransmittance * (1 - sample.alpha) - transmittance * dalpha, dtransmittance
        )
        return pair + 1, goes_on, after, dtransmittance, dout

    state = (begin, mi.Bool(inside), mi.Float(1), mi.Float(0), [mi.Float(0) for _ in range(maps)])
    dout = dr.while_loop(state, condition, body, label="blend_forward")[-1]
    return _to_raster(op, dout, raster, inside)
