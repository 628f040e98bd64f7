"""Front-to-back compositing of K features, its adjoint and its tangent: three traced loops over tile lists.

    out_k = Σᵢ wᵢ f_ik,    wᵢ = αᵢ Tᵢ,    Tᵢ = Π_{j<i} (1 - αⱼ)                             [2DGS, eq. 12]

Depth and accumulated alpha are two more features (f = z and f = 1). The adjoint replays the same order; with
gᵢ = Σ_k δ_k f_ik, and S = Σ_k δ_k out_k less wᵢ gᵢ at each step, which is what lies behind,

    δf_ik = wᵢ δ_k,        δαᵢ = Tᵢ gᵢ - S_{j>i} / (1 - αᵢ)

needs neither a reversed list nor storage per pair. The first features may vary over their surfel, by what
`turns` adds per standard deviation u and v: f + u f_u + v f_v, with u = v = 0 where the low-pass decides.

No derivative, on purpose: the sort order, the tile lists, the α < 1/255 cut and the end at T < 1e-4, the near
plane, the clamp at α_max (zero). The border of a footprint does not move: with ε = 1/255, mean gradients of
size and position fall short by the part ε ln(o/ε) / (o - ε), those of opacity by ε/o.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.kernels.rows import PackedRows
from mi_refgs.kernels.timing import boundary, phase
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.lanes import Lanes, advance, any_of, walk
from mi_refgs.splat.tiles import TileLists
from mi_refgs.surfels.primitives.primitive import Footprints
from mi_refgs.types import Bool, Float, UInt32


@dataclass(frozen=True)
class Composited:
    """Maps of H·W pixels in raster order, not divided by alpha."""

    features: list[Float]  # K maps Σ w f
    depth: Float  # Σ w z
    alpha: Float  # Σ w

    @staticmethod
    def nothing(features: int, camera: Camera) -> Composited:
        """Maps of a view without surfels."""
        *maps, z, alpha = _blank(features + 2, camera)
        return Composited(maps, z, alpha)

    @property
    def expected_depth(self) -> Float:
        """Camera-z depth, 0 where nothing is seen."""
        return self.depth * inverse_alpha(self.alpha)


def inverse_alpha(alpha: Float) -> Float:
    """1/A where anything is seen (COVERAGE_FLOOR), else 0, with a finite gradient everywhere."""
    seen = alpha > COVERAGE_FLOOR
    return dr.select(seen, dr.rcp(dr.select(seen, alpha, 1)), 0)


@phase("splat forward", backward="splat backward")
def composite(
    footprints: Footprints, features: list[Float], lists: TileLists, turns: list[Float] | None = None
) -> Composited:
    """Maps of H·W pixels; differentiable in footprints, features and turns (N,), whose values `lists` has."""
    footprints, features, turns = boundary((footprints, features, turns or []), "surfels backward")
    out = dr.custom(_Composite, [*footprints.columns, *features, *turns], lists)
    return Composited(out[: len(features)], *out[-2:])


def _values(lists: TileLists, row: list[Float], sample: Any, count: int) -> list[Float]:
    """What a surfel adds to each map, times its weight: the first features, depth, and 1 for alpha."""
    features = row[lists.primitive.columns :][:count]
    if lists.turned:
        (u, v), (by_u, by_v) = _inside(sample), _turns(lists, row)
        features[: lists.turned] = [
            dr.fma(u, a, dr.fma(v, b, f)) for a, b, f in zip(by_u, by_v, features, strict=False)
        ]
    return [*features, sample.z, mi.Float(1)]


def _turns(lists: TileLists, row: list[Float]) -> tuple[list[Float], list[Float]]:
    """What the turned features gain per standard deviation along u and along v."""
    first = lists.primitive.columns + lists.features
    return row[first:][: lists.turned], row[first + lists.turned :][: lists.turned]


def _inside(sample: Any) -> list[Float]:
    """Standard deviations u and v of a sample from its surfel's centre, 0 where the low-pass decides."""
    return [dr.select(sample.low_pass, 0, x) for x in (sample.u, sample.v)]


def _forward(lists: TileLists, lanes: Lanes, features: int) -> list[list[Float]]:
    """The maps of so many features, of depth and of alpha, per pixel of the lanes."""

    def step(surfel: UInt32, some: Bool, active: list[Bool], *state: list[Any]) -> Any:
        row = lists.rows.fetch(surfel, some)
        after = []
        for pixel, _, _, active_here, transmittance, out in lanes.each(active, *state):
            sample = lists.primitive.evaluate(row, pixel, lists.camera.near)
            weight, transmittance_after, goes_on = advance(sample, active_here, transmittance)
            values = _values(lists, row, sample, features)
            out = [dr.fma(weight, value, total) for value, total in zip(values, out, strict=True)]
            after.append((goes_on, transmittance_after, out))
        return after

    start = [(mi.Bool(inside), mi.Float(1), [mi.Float(0)] * (features + 2)) for inside in lanes.inside]
    *_, out = walk(lists, lanes, step, start, "composite")
    return out


def _backward(
    lists: TileLists, lanes: Lanes, δ: list[list[Float]], out: list[list[Float]], δrows: PackedRows
) -> None:
    """Add the adjoint of the rows, for adjoints δ of the maps and the maps, per pixel of the lanes."""
    behind = [_dot(of_pixel, total) for of_pixel, total in zip(δ, out, strict=True)]
    features = len(δ[0]) - 2

    def step(surfel: UInt32, some: Bool, active: list[Bool], *state: list[Any]) -> Any:
        row = lists.rows.fetch(surfel, some)
        after, weights, places = [], [], []
        geometry = lists.primitive.adjoint()
        # Adjoints of α and z per pixel, summed over the pixels of the lane.
        for pixel, _, _, active_here, transmittance, behind_here, δhere in lanes.each(active, *state, δ):
            sample = lists.primitive.evaluate(row, pixel, lists.camera.near)
            weight, transmittance_after, goes_on = advance(sample, active_here, transmittance)
            g = mi.Float(0)
            for adjoint, value in zip(δhere, _values(lists, row, sample, features), strict=True):
                g = dr.fma(adjoint, value, g)
            rest = dr.fma(-weight, g, behind_here)
            δalpha = dr.select(weight > 0, dr.fma(transmittance, g, -rest / (1 - sample.alpha)), 0)
            moved: list[Float] = []
            if lists.turned:
                places.append([weight * x for x in _inside(sample)])
                δturned = δhere[: lists.turned]
                moved = [weight * _dot(δturned, turn) for turn in _turns(lists, row)]  # adjoints of u and v
            geometry.add(sample, δalpha, weight * δhere[-2], *moved)
            after.append((goes_on, transmittance_after, rest))
            weights.append(weight)
        # One addition per lane to the adjoint of the row.
        δrow = geometry.columns(row)
        for k in range(features):
            δfeature = mi.Float(0)
            for weight, δhere in zip(weights, δ, strict=True):
                δfeature = dr.fma(weight, δhere[k], δfeature)
            δrow.append(δfeature)
        turned = lists.turned if features == lists.features else 0  # surfels of few features do not turn
        for axis, k in itertools.product(range(2), range(turned)):
            δrow.append(_dot([of_pixel[axis] for of_pixel in places], [δhere[k] for δhere in δ]))
        δrows.add(surfel, δrow, any_of([weight > 0 for weight in weights]))
        return after

    start = [(mi.Bool(a), mi.Float(1), b) for a, b in zip(lanes.inside, behind, strict=True)]
    walk(lists, lanes, step, start, "composite_backward")
    dr.eval(δrows.data)


def _dot(first: list[Float], second: list[Float]) -> Float:
    return sum((a * b for a, b in zip(first, second, strict=True)), start=mi.Float(0))


def _tangent(lists: TileLists, lanes: Lanes, drows: PackedRows) -> list[list[Float]]:
    """Tangents of the maps, per pixel of the lanes, for tangents of the rows: Dr.Jit's, of each step."""

    def step(surfel: UInt32, some: Bool, active: list[Bool], *state: list[Any]) -> Any:
        row, drow = lists.rows.fetch(surfel, some), drows.fetch(surfel, some)
        after = []
        for pixel, _, _, active_here, transmittance, dtransmittance, dout in lanes.each(active, *state):
            with dr.resume_grad():
                start = dr.copy([*row, transmittance])
                dr.enable_grad(start)
                dr.set_grad(start, [*drow, dtransmittance])
                sample = lists.primitive.evaluate(start, pixel, lists.camera.near)
                weight, transmittance_after, goes_on = advance(sample, active_here, start[-1])
                maps = [weight * value for value in _values(lists, start, sample, lists.features)]
                *dmaps, dafter = dr.forward_to([*maps, transmittance_after])
            dout = [total + dmap for total, dmap in zip(dout, dmaps, strict=True)]
            after.append((goes_on, dr.detach(transmittance_after), dafter, dout))
        return after

    zeros = [mi.Float(0)] * (lists.features + 2)
    start = [(mi.Bool(inside), mi.Float(1), mi.Float(0), zeros) for inside in lanes.inside]
    *_, dout = walk(lists, lanes, step, start, "composite_forward")
    return dout


class _Composite(dr.CustomOp):
    """Columns (N,) of the footprints, then features and turns, → [features…, depth, alpha] (H·W,)."""

    def eval(self, columns: list[Any], lists: TileLists) -> list[Any]:
        self.lists = lists
        dr.eval(lists.rows.data)
        self.out = _blank(lists.features + 2, lists.camera)
        self.parts = Lanes.parts(lists) if lists.pairs else []  # Dr.Jit refuses to gather from an empty list
        for lanes, count in self.parts:
            values = _forward(lists, lanes, count)
            lanes.to_raster(_maps(self.out, count), values)
        return self.out

    def forward(self) -> None:
        lists, dout = self.lists, _blank(self.lists.features + 2, self.lists.camera)
        if lists.pairs:
            lanes, drows = Lanes.of(lists), PackedRows.pack(self.grad_in("columns"))
            lanes.to_raster(dout, _tangent(lists, lanes, drows))
        self.set_grad_out(dout)

    def backward(self) -> None:
        if not self.lists.pairs:
            return
        δout, rows = self.grad_out(), self.lists.rows
        dr.eval(δout)  # together: to gather from them would evaluate one by one what they have in common
        δrows = PackedRows.zeros(rows.count, rows.width)
        for lanes, count in self.parts:
            δ, out = (lanes.from_raster(_maps(images, count)) for images in (δout, self.out))
            _backward(self.lists, lanes, δ, out, δrows)
        self.set_grad_in("columns", δrows.columns())


def _maps(every: list[Float], features: int) -> list[Float]:
    """The maps of the first features, of depth and of alpha."""
    return [*every[:features], *every[-2:]]


def _blank(count: int, camera: Camera) -> list[Float]:
    """Maps (H·W,) of a view without surfels."""
    return [dr.zeros(mi.Float, camera.width * camera.height) for _ in range(count)]
