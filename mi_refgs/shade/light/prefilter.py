"""The GGX prefilter in Dr.Jit: three gather-only kernels each way, for the matrices of `lobe_matrices`.

    radiance ─ analyse ─► Fourier rows ─ mix rows ─► Fourier rows of every level ─ synthesise ─► levels
    δradiance ◄ synthesise ─ Fourier rows ◄ mix rows (transposed) ─ Fourier rows ◄ analyse ─ δlevels

The levels are one flat buffer of RGBA texels, the map itself first; A is padding, so that a lookup is one
packet.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import replayed, upload
from mi_refgs.shade import mixing
from mi_refgs.shade.light import fourier, lobe_matrices
from mi_refgs.shade.light.lobe_matrices import LEVELS, Levels


@dataclass(frozen=True)
class Operator:
    """The prefilter of maps with `height` rows: buffers, matrices, and where each level is in the result."""

    height: int
    base: fourier.RowLayout
    levels: fourier.RowLayout
    forward: mixing.Mixing
    adjoint: mixing.Mixing
    info: Any  # 4 UInt32 a level: first texel, h, w, 0; level 0 is the map itself
    shapes: tuple[tuple[int, int], ...]  # (first texel, h) of each level, the same on the host
    roughness: tuple[float, ...]  # of each level but the map itself


@functools.lru_cache(maxsize=4)
def _host_levels(height: int, levels: Levels) -> list[lobe_matrices.Level]:
    return lobe_matrices.build_levels(height, levels)


def _build(height: int, wanted: Levels) -> Operator:
    matrices = [level.weights for level in _host_levels(height, wanted)]
    transposed = [np.ascontiguousarray(matrix.swapaxes(0, 1)) for matrix in matrices]
    heights = [height] + [len(matrix) for matrix in matrices]
    firsts = [int(n) for n in np.cumsum([0] + [2 * h * h for h in heights])]
    frequencies = max(matrix.shape[2] for matrix in matrices)
    limit_in = fourier.row_limits(
        [np.pad(m, ((0, 0), (0, 0), (0, frequencies - m.shape[2]))) for m in transposed]
    )
    limits_out = [fourier.row_limits([matrix]) for matrix in matrices]
    (slot_in,), slots_out = fourier.row_slots([limit_in]), fourier.row_slots(limits_out)
    base, levels = (
        fourier.make_rows([0], [limit_in]),
        fourier.make_rows(firsts[1:-1], limits_out),
    )
    out = list(zip(slots_out, limits_out, strict=True))
    return Operator(
        height=height,
        base=base,
        levels=levels,
        forward=mixing.make_mixing(
            [(m, slot_in, s, n) for m, (s, n) in zip(matrices, out, strict=True)],
            levels.coefficients,
        ),
        adjoint=mixing.make_mixing(
            [(m, s, slot_in, limit_in) for m, (s, _) in zip(transposed, out, strict=True)],
            base.coefficients,
        ),
        info=upload(np.array([(f, h, 2 * h, 0) for f, h in zip(firsts, heights, strict=False)]), mi.UInt32),
        shapes=tuple(zip(firsts, heights, strict=False)),
        roughness=wanted.roughness,
    )


def apply(op: Operator, radiance: Any) -> Any:
    """Flat RGBA levels, the map first, of flat radiance (3·h·w)."""
    out = dr.empty(mi.Float, 4 * op.levels.texels)
    texel = dr.arange(mi.UInt32, op.base.texels)
    fourier.write(out, [dr.gather(mi.Float, radiance, 3 * texel + c) for c in range(3)], texel)
    dr.eval(out)
    fourier.synthesise(op.levels, mixing.mix_rows(op.forward, fourier.analyse(op.base, out)), out)
    return out


def apply_transposed(op: Operator, δlevels: Any) -> Any:
    """Adjoint of `apply`: flat δradiance (3·h·w) of flat RGBA δlevels."""
    dr.eval(δlevels)
    out = dr.empty(mi.Float, 4 * op.base.texels)
    fourier.synthesise(op.base, mixing.mix_rows(op.adjoint, fourier.analyse(op.levels, δlevels)), out)
    n = dr.arange(mi.UInt32, 3 * op.base.texels)
    texel = 4 * (n // 3) + n % 3
    return dr.gather(mi.Float, out, texel) + dr.gather(mi.Float, δlevels, texel)


@dataclass(frozen=True)
class _Prepared:
    """An operator, and `apply` and `apply_transposed` of it, which are traced once and then replayed.

    Tracing them takes as long as running them. All their sizes are the operator's own, so that a recording
    holds for every call.
    """

    operator: Operator
    forward: Callable[[Any], Any]
    adjoint: Callable[[Any], Any]


@functools.lru_cache(maxsize=4)
def _prepare(variant: str, height: int, levels: Levels) -> _Prepared:
    op = _build(height, levels)

    return _Prepared(
        op,
        replayed(lambda radiance: apply(op, radiance)),
        replayed(lambda δlevels: apply_transposed(op, δlevels)),
    )


def operator(height: int, levels: Levels = LEVELS) -> Operator:
    """The prefilter for maps (height, 2·height), built once a height, levels and variant (64 rows: 1 s)."""
    return _prepare(mi.variant(), height, levels).operator


class _Prefilter(dr.CustomOp):
    """`apply` under automatic differentiation; linear, so its derivative is itself."""

    def eval(self, prepared: _Prepared, radiance: Any) -> Any:
        self.prepared = prepared
        return prepared.forward(_opaque(radiance))

    def forward(self) -> None:
        self.set_grad_out(self.prepared.forward(_opaque(self.grad_in("radiance"))))

    def backward(self) -> None:
        self.set_grad_in("radiance", self.prepared.adjoint(_opaque(self.grad_out())))

    def name(self) -> str:
        return "prefilter"


def _opaque(values: Any) -> Any:
    """The values in memory: Dr.Jit would record another function for a literal."""
    dr.make_opaque(values)
    return values


def prefilter(radiance: Any, levels: Levels = LEVELS) -> tuple[Operator, Any]:
    """Operator and levels (flat RGBA, under AD) of a radiance tensor (h, 2h, 3), h a multiple of 4."""
    prepared = _prepare(mi.variant(), radiance.shape[0], levels)
    return prepared.operator, dr.custom(_Prefilter, prepared, radiance.array)
