"""The GGX prefilter in Dr.Jit: three gather-only kernels each way, for the matrices of `lobe_matrices`.

    radiance ─ analyse ─► Fourier rows ─ mix rows ─► Fourier rows of every level ─ synthesise ─► levels
    δradiance ◄ synthesise ─ Fourier rows ◄ mix rows (transposed) ─ Fourier rows ◄ analyse ─ δlevels

A texel buffer is flat, TEXEL floats per texel: RGBA, A unused, so that a lookup is one access. The levels are
one such buffer, the map itself first. A Fourier buffer has COEFFICIENT floats per coefficient: the cosine
coefficients of R, G and B, the sine coefficients, and two unused. Rows keep only the frequencies they need.
Analysis and synthesis are each other's transpose and only gather: adjoints use the same kernels, and no
atomics.
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
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.lobe_matrices import LEVELS, Levels

BLOCK = 4  # consecutive rows with the same number of frequencies, which `mix_rows` computes in one lane

COEFFICIENT = 8
"""Floats per coefficient; TEXEL floats per texel. Powers of two, as accesses are."""
TEXEL = 4


@dataclass(frozen=True)
class RowLayout:
    """Places of the rows of several lat-long grids in a texel buffer and in a Fourier buffer.

    Analysis has one lane per four columns, to fold them, then one per four frequencies; synthesis has one per
    sixteen columns, two times eight that share their cosines.
    """

    texels: int
    coefficients: int
    folding: tuple[Any, Any, Any]  # per lane: texel of the row's start, w, column below w/4
    analysis: tuple[Any, Any, Any, Any]  # per lane: texel of the row's start, w, m, offset of the twiddles
    slots: tuple[Any, ...]  # where m, w/2-m, w/4-m and w/4+m go ...
    exists: tuple[Any, ...]  # ... and whether they do
    # Per lane: texel of the row's start, w, column, offset of the twiddles, first slot, M.
    synthesis: tuple[Any, Any, Any, Any, Any, Any]
    twiddles: Any  # pairs of cos and sin of multiples of π/w


def to_device(*columns: np.ndarray) -> tuple[Any, ...]:
    return tuple(upload(column, mi.UInt32) for column in columns)


def row_limits(weights: list[np.ndarray]) -> np.ndarray:
    """Frequencies (rows,) per row that any of `weights` (rows, ·, M) uses, equal within a block."""
    need = [np.where(w.any(1), np.arange(1, w.shape[2] + 1), 0).max(1) for w in weights]
    return np.repeat(np.max(need, 0).reshape(-1, BLOCK).max(1), BLOCK)


def row_slots(limits: list[np.ndarray]) -> list[np.ndarray]:
    """First coefficient of each row, for consecutive grids in the buffer."""
    ends = np.cumsum(np.concatenate(limits))
    return np.split(ends - np.concatenate(limits), np.cumsum([len(m) for m in limits])[:-1])


def make_rows(firsts: list[int], limits: list[np.ndarray]) -> RowLayout:
    """Lanes for grids of len(limit) rows and twice as many columns, from texels `firsts` on."""
    folding, analysis, slots, exists, synthesis, twiddles, at = [], [], [], [], [], [], 0
    for first, limit, slot in zip(firsts, limits, row_slots(limits), strict=True):
        h, w = len(limit), 2 * len(limit)
        angle = np.arange(2 * w) * (np.pi / w)
        twiddles.append(np.stack([np.cos(angle), np.sin(angle)], 1).ravel())
        i, j = (a.ravel() for a in np.meshgrid(np.arange(h), np.arange(w // 4), indexing="ij"))
        folding.append(np.stack([first + w * i, 0 * i + w, j]))
        i, m = np.nonzero(np.arange(w // 8 + 1) < limit[:, None])
        others = np.stack([m, w // 2 - m, w // 4 - m, w // 4 + m])
        # At m = 0 and at m = w/8 some of the four are the same frequency; the first one writes it.
        there = (others < limit[i]) & np.stack([m >= 0, m >= 0, m < w // 8, (m > 0) & (m < w // 8)])
        analysis.append(np.stack([first + w * i, 0 * i + w, m, 0 * i + at]))
        slots.append(np.where(there, slot[i] + others, 0))
        exists.append(there)
        i, q = (a.ravel() for a in np.meshgrid(np.arange(h), np.arange(-(-w // 16)), indexing="ij"))
        synthesis.append(np.stack([first + w * i, 0 * i + w, q, 0 * i + at, slot[i], limit[i]]))
        at += 2 * w
    return RowLayout(
        texels=firsts[-1] + 2 * len(limits[-1]) ** 2,
        coefficients=int(sum(limit.sum() for limit in limits)),
        folding=to_device(*np.concatenate(folding, 1)),
        analysis=to_device(*np.concatenate(analysis, 1)),
        slots=to_device(*np.concatenate(slots, 1)),
        exists=tuple(upload(row, mi.Bool) for row in np.concatenate(exists, 1)),
        synthesis=to_device(*np.concatenate(synthesis, 1)),
        twiddles=upload(np.concatenate(twiddles)),
    )


def write(target: Any, values: list[Any], place: Any, active: Any = True) -> None:
    """Scatter groups of values to distinct indices, padded with zeros to TEXEL or COEFFICIENT floats."""
    padded = values + [mi.Float(0)] * ((TEXEL if len(values) <= TEXEL else COEFFICIENT) - len(values))
    # Without the promise of no conflicts Dr.Jit runs one kernel, loop and all, per scatter.
    dr.scatter(target, mi.ArrayXf(padded), place, active, mode=dr.ReduceMode.NoConflicts)


def read(size: int, source: Any, place: Any, active: Any = True) -> list[Any]:
    return list(dr.gather(mi.ArrayXf, source, place, active, shape=(size, dr.width(place))))


def _turn(turn: Any, step: Any, w: Any) -> Any:
    """Advance a twiddle index, an angle in units of π/w, by `step` < 2w."""
    turn = turn + step
    return dr.select(turn >= 2 * w, turn - 2 * w, turn)


def _four_turns(rows: RowLayout, at: Any, turn: Any, step: Any, w: Any) -> tuple[list[tuple[Any, Any]], Any]:
    """(cos, sin) at `turn` and after one, two and three steps, and the turn after four.

    One is looked up and three are rotated from it: lookups dominate the time of these loops, and a longer
    chain of rotations would lose digits.
    """
    cos, sin = read(2, rows.twiddles, at + turn)
    c, s = read(2, rows.twiddles, at + step)  # the same in every turn of a loop: read once
    angles = [(cos, sin)]
    for _ in range(3):
        cos, sin = dr.fma(cos, c, -sin * s), dr.fma(cos, s, sin * c)
        angles.append((cos, sin))
    return angles, _turn(_turn(turn, 2 * step, w), 2 * step, w)


def _fold(rows: RowLayout, texels: Any) -> Any:
    """Sum four columns with the same cosines and sines, up to signs.

    Index 2 (row's start/4 + j) has the sums for even frequencies, the next one those for odd ones: first the
    factors of the cosine at column j, then those of the sine.
    """
    start, w, j = rows.folding
    half = w // 2
    columns = (j, w - 1 - j, half + j, half - 1 - j)
    colours = list(zip(*(read(TEXEL, texels, start + column)[:3] for column in columns), strict=True))
    out = dr.empty(mi.Float, COEFFICIENT * (rows.texels // 2))
    for parity, sign in enumerate((1, -1)):
        cosines = [a + b + sign * (c + d) for a, b, c, d in colours]
        sines = [a - b + sign * (c - d) for a, b, c, d in colours]
        write(out, cosines + sines, 2 * (start // 4 + j) + parity)
    dr.eval(out)
    return out


def analyse(rows: RowLayout, texels: Any) -> Any:
    """Fourier buffer Σ_j x_j (cos mφ_j, sin mφ_j) of every row and frequency of a flat texel buffer."""
    start, w, m, at = rows.analysis
    folded = _fold(rows, texels)
    quarter = w // 4
    place = 2 * (start // 4) + m % 2  # w/2 - m and w/4 ± m are as even or odd as m

    def body(j: Any, turn: Any, *acc: Any) -> tuple[Any, ...]:
        out = []
        angles, turn = _four_turns(rows, at, turn, 2 * m, w)  # φ_j = π(2j+1)/w
        for r, (cos, sin) in enumerate(angles):
            x = read(COEFFICIENT, folded, place + 2 * (j + r), j + r < quarter)[:6]
            out += [dr.fma(x[c], cos, acc[12 * r + c]) for c in range(6)]
            out += [dr.fma(x[c], sin, acc[12 * r + 6 + c]) for c in range(6)]
        return (j + 4, turn, *out)

    n = dr.width(m)
    zeros = [dr.zeros(mi.Float, n) for _ in range(48)]
    _, _, *sums = dr.while_loop((dr.zeros(mi.UInt32, n), m, *zeros), lambda j, *_: j < quarter, body)
    by_cos, by_sin = ([sums[12 * r + k : 12 * r + k + 6] for r in range(4)] for k in (0, 6))
    # The frequency f - m or f + m turns by γ_j = fφ_j on top: π(j+½) or π(j+½)/2, which repeats after 4.
    q = 0.5**0.5
    quarters = (
        ((1, 1, 1, 1), (0, 0, 0, 0), 1),  # cos γ, sin γ, sign of m
        ((0, 0, 0, 0), (1, -1, 1, -1), -1),
        ((q, -q, -q, q), (q, q, -q, -q), -1),
        ((q, -q, -q, q), (q, q, -q, -q), 1),
    )
    out = dr.empty(mi.Float, COEFFICIENT * rows.coefficients)
    for (cos_γ, sin_γ, sign), slot, exists in zip(quarters, rows.slots, rows.exists, strict=True):
        terms = list(zip(cos_γ, sin_γ, by_cos, by_sin, strict=True))
        cos = [sum(cγ * x[c] - sign * sγ * y[c] for cγ, sγ, x, y in terms) for c in range(3)]
        sin = [sum(sγ * x[c] + sign * cγ * y[c] for cγ, sγ, x, y in terms) for c in range(3, 6)]
        write(out, cos + sin, slot, exists)
    return out


def synthesise(rows: RowLayout, coefficients: Any, texels: Any) -> None:
    """Write Σ_m (a_m cos mφ_j + b_m sin mφ_j) of every row and column into the RGBA buffer `texels`."""
    start, w, q, at, slot, limit = rows.synthesis
    columns = (q, q + (w // 8 + 1) // 2)  # one read of a coefficient is used for both

    def body(m: Any, turns: Any, sums: Any) -> tuple[Any, ...]:
        sums = [list(of_column) for of_column in sums]
        turned = [
            _four_turns(rows, at, turn, 2 * column + 1, w)
            for turn, column in zip(turns, columns, strict=True)
        ]
        for r in range(4):
            x = read(COEFFICIENT, coefficients, slot + m + r, m + r < limit)
            for (angles, _), out in zip(turned, sums, strict=True):
                _add_frequency(out, r, x, *angles[r])
        return m + 4, [turn for _, turn in turned], sums

    zeros = [[dr.zeros(mi.Float, dr.width(q)) for _ in range(24)] for _ in columns]
    start_state = (dr.zeros(mi.UInt32, dr.width(q)), [mi.UInt32(0) for _ in columns], zeros)
    _, _, sums = dr.while_loop(start_state, lambda m, *_: m < limit, body)
    for column, of_column in zip(columns, sums, strict=True):
        _unfold(texels, start, w, column, of_column)


def _add_frequency(sums: list[Any], r: int, x: list[Any], cos: Any, sin: Any) -> None:
    """Add the coefficients x of a frequency m ≡ r (mod 4) to the 24 sums of a column, see `_unfold`."""

    def add(n: int, a: Any, b: Any) -> None:
        sums[n] = dr.fma(a, b, sums[n])

    for c in range(3):
        a, b = x[c], x[3 + c]
        if r % 2 == 0:
            add(3 * r + c, a, cos)
            add(3 * r + 3 + c, b, sin)
        else:
            sign = 2 - r
            add(12 + c, a, cos)
            add(15 + c, b, sin)
            add(18 + c, a, sign * sin)
            add(21 + c, b, sign * cos)


def _unfold(texels: Any, start: Any, w: Any, q: Any, sums: list[Any]) -> None:
    """Write the eight columns at the azimuths kπ/2 ± φ, φ that of column q.

    m ≡ 2 (mod 4) changes sign, odd m swaps cosine and sine when k is odd.
    """
    even_cos, even_sin, two_cos, two_sin, odd_cos, odd_sin, cross_sin, cross_cos = (
        sums[3 * k : 3 * k + 3] for k in range(8)
    )
    for k in range(4):
        for ε in (1, -1):
            column = q + k * (w // 4) if ε > 0 else ((k or 4) * (w // 4)) - 1 - q
            colour = []
            for c in range(3):
                value = even_cos[c] + ε * even_sin[c] + (-1) ** k * (two_cos[c] + ε * two_sin[c])
                odd = cross_cos[c] - ε * cross_sin[c] if k % 2 else odd_cos[c] + ε * odd_sin[c]
                colour.append(value + (odd if k < 2 else -odd))
            write(texels, colour, start + column, q < w // 8)


@dataclass(frozen=True)
class Mixing:
    """A block-sparse matrix between Fourier buffers: each lane has four outputs, of entries [begin, end)."""

    outputs: int
    begin: Any
    end: Any
    slot: Any  # first of the four outputs
    step: Any  # from one output to the next
    source: Any  # input coefficient of each entry
    weights: Any  # four floats per entry


def make_mixing(blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]], outputs: int) -> Mixing:
    """Sum pieces (rows, columns, M), each with slots of its columns, and slots and limits of its rows."""
    slots, steps, sources, weights = [], [], [], []
    for matrix, slot_in, slot_out, limit_out in blocks:
        quads = matrix.reshape(-1, BLOCK, *matrix.shape[1:])
        b, m, k = np.nonzero((quads != 0).any(1).swapaxes(1, 2))
        slots.append(slot_out[BLOCK * b] + m)
        steps.append(limit_out[BLOCK * b])
        sources.append(slot_in[k] + m)
        weights.append(quads[b, :, k, m])
    slot, step, source, weight = (np.concatenate(a) for a in (slots, steps, sources, weights))
    order = np.lexsort((source, slot))
    slot, step, source, weight = slot[order], step[order], source[order], weight[order]
    begin = np.flatnonzero(np.diff(slot, prepend=-1))
    end = np.append(begin[1:], len(slot))
    # Equally long lanes side by side: a SIMD vector runs until its longest lane ends.
    lanes = np.argsort(begin - end, kind="stable")
    begin, end = begin[lanes], end[lanes]
    first, last, place, stride, origin = to_device(begin, end, slot[begin], step[begin], source)
    return Mixing(outputs, first, last, place, stride, origin, upload(weight))


def mix_rows(matrix: Mixing, coefficients: Any) -> Any:
    """Multiply a Fourier buffer by a block-sparse matrix."""

    def body(n: Any, *acc: Any) -> tuple[Any, ...]:
        out = list(acc)
        source = dr.gather(mi.UInt32, matrix.source, n)
        weight = dr.gather(mi.Vector4f, matrix.weights, n)
        for c, x in enumerate(read(COEFFICIENT, coefficients, source)[:6]):
            for row in range(BLOCK):
                out[6 * row + c] = dr.fma(weight[row], x, out[6 * row + c])
        return (n + 1, *out)

    zeros = [dr.zeros(mi.Float, dr.width(matrix.begin)) for _ in range(6 * BLOCK)]
    state = dr.while_loop((mi.UInt32(matrix.begin), *zeros), lambda n, *_: n < matrix.end, body)
    out = dr.zeros(mi.Float, COEFFICIENT * matrix.outputs)
    for row in range(BLOCK):
        write(out, list(state[1 + 6 * row : 7 + 6 * row]), matrix.slot + row * matrix.step)
    return out


@dataclass(frozen=True)
class Operator:
    """The prefilter of maps with `height` rows: buffers, matrices, and where each level is in the result."""

    height: int
    base: RowLayout
    levels: RowLayout
    forward: Mixing
    adjoint: Mixing
    info: Any  # 4 UInt32 a level: first texel, h, w, 0; level 0 is the map itself
    shapes: tuple[tuple[int, int], ...]  # (first texel, h) of each level, the same on the host
    roughness: tuple[float, ...]  # of each level but the map itself


@functools.lru_cache(maxsize=4)
def _host_levels(height: int, levels: Levels) -> list[lobe_matrices.Level]:
    return lobe_matrices.build_levels(height, levels)  # the same in every variant


def _build(height: int, wanted: Levels) -> Operator:
    matrices = [level.weights for level in _host_levels(height, wanted)]
    transposed = [np.ascontiguousarray(matrix.swapaxes(0, 1)) for matrix in matrices]
    heights = [height] + [len(matrix) for matrix in matrices]
    firsts = [int(n) for n in np.cumsum([0] + [2 * h * h for h in heights])]
    frequencies = max(matrix.shape[2] for matrix in matrices)
    limit_in = row_limits([np.pad(m, ((0, 0), (0, 0), (0, frequencies - m.shape[2]))) for m in transposed])
    limits_out = [row_limits([matrix]) for matrix in matrices]
    (slot_in,), slots_out = row_slots([limit_in]), row_slots(limits_out)
    base, levels = make_rows([0], [limit_in]), make_rows(firsts[1:-1], limits_out)
    forward = [(m, slot_in, s, n) for m, s, n in zip(matrices, slots_out, limits_out, strict=True)]
    adjoint = [(m, s, slot_in, limit_in) for m, s in zip(transposed, slots_out, strict=True)]
    return Operator(
        height=height,
        base=base,
        levels=levels,
        forward=make_mixing(forward, levels.coefficients),
        adjoint=make_mixing(adjoint, base.coefficients),
        info=upload(np.array([(f, h, 2 * h, 0) for f, h in zip(firsts, heights, strict=False)]), mi.UInt32),
        shapes=tuple(zip(firsts, heights, strict=False)),
        roughness=wanted.roughness,
    )


def apply(op: Operator, radiance: Any) -> Any:
    """Flat RGBA levels, the map first, of flat radiance (3·h·w)."""
    out = dr.empty(mi.Float, 4 * op.levels.texels)
    texel = dr.arange(mi.UInt32, op.base.texels)
    write(out, [dr.gather(mi.Float, radiance, 3 * texel + c) for c in range(3)], texel)
    dr.eval(out)
    synthesise(op.levels, mix_rows(op.forward, analyse(op.base, out)), out)
    return out


def apply_transposed(op: Operator, δlevels: Any) -> Any:
    """Adjoint of `apply`: flat δradiance (3·h·w) of flat RGBA δlevels."""
    dr.eval(δlevels)
    out = dr.empty(mi.Float, 4 * op.base.texels)
    synthesise(op.base, mix_rows(op.adjoint, analyse(op.levels, δlevels)), out)
    n = dr.arange(mi.UInt32, 3 * op.base.texels)
    texel = 4 * (n // 3) + n % 3
    return dr.gather(mi.Float, out, texel) + dr.gather(mi.Float, δlevels, texel)


_Function = Callable[[Any], Any]


@functools.lru_cache(maxsize=4)
def _prepare(variant: str, height: int, levels: Levels) -> tuple[Operator, _Function, _Function]:
    """An operator with its `apply` and `apply_transposed`, traced once and then replayed.

    Tracing them takes as long as running them. All sizes are the operator's own, so that a recording is valid
    for every call.
    """
    op = _build(height, levels)
    return op, replayed(lambda radiance: apply(op, radiance)), replayed(lambda δ: apply_transposed(op, δ))


def operator(height: int, levels: Levels = LEVELS) -> Operator:
    """The prefilter for maps (height, 2·height), built once per height, levels and variant (64 rows: 1 s)."""
    return _prepare(mi.variant(), height, levels)[0]


class _Prefilter(dr.CustomOp):
    """`apply` under AD; linear, so that its derivative is itself."""

    def eval(self, functions: tuple[_Function, _Function], radiance: Any) -> Any:
        self.apply, self.transposed = functions
        return self.apply(_opaque(radiance))

    def forward(self) -> None:
        self.set_grad_out(self.apply(_opaque(self.grad_in("radiance"))))

    def backward(self) -> None:
        self.set_grad_in("radiance", self.transposed(_opaque(self.grad_out())))

    def name(self) -> str:
        return "prefilter"


def _opaque(values: Any) -> Any:
    """The values in memory: Dr.Jit would record another function for a literal."""
    dr.make_opaque(values)
    return values


def prefilter(radiance: Any, levels: Levels = LEVELS) -> tuple[Operator, Any]:
    """Operator and levels (flat RGBA, under AD) of a radiance tensor (h, 2h, 3), h a multiple of 4."""
    operator, *functions = _prepare(mi.variant(), radiance.shape[0], levels)
    return operator, dr.custom(_Prefilter, tuple(functions), radiance.array)
