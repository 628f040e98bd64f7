"""The prefilter as kernels, for a GPU: sums over a row in place of the FFTs of `prefilter` on the host, whose
steps and names these are. Maps (h, 2h) and their coefficients are one after the other."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.sparse import csc_matrix

from mi_refgs.kernels.device import upload
from mi_refgs.types import Float, UInt32

Shapes = Sequence[tuple[int, int]]  # first texel and h of each map
TEXEL = 4  # floats per texel: RGB and one unused
COEFFICIENT = 8  # floats per coefficient: real parts of RGB, one unused, imaginary parts of RGB, one unused


@dataclass(frozen=True)
class Terms:
    """What each result is a sum of: every `step`-th place from `begin`, at angles of 2π/turns."""

    begin: UInt32
    step: UInt32
    count: UInt32
    angle: UInt32  # of the first
    turn: UInt32  # from one to the next

    def sums(self, size: int, turns: int, add: Callable[..., list[Float]]) -> list[Float]:
        """`size` sums per result; `add` maps sums, place, cosine and sine to the next sums."""
        cosine, sine = _circle(str(mi.variant()), turns)

        def body(n: UInt32, place: UInt32, angle: UInt32, sums: list[Float]) -> Any:
            c, s = dr.gather(mi.Float, cosine, angle), dr.gather(mi.Float, sine, angle)
            return n + 1, place + self.step, (angle + self.turn) % turns, add(sums, place, c, s)

        start = (mi.UInt32(0), self.begin, self.angle, [mi.Float(0)] * size)
        return list(dr.while_loop(start, lambda n, *_: n < self.count, body, label="prefilter")[-1])


@functools.lru_cache(maxsize=4)
def _circle(variant: str, turns: int) -> tuple[Float, Float]:
    angle = 2 * np.pi / turns * np.arange(turns)
    return upload(np.cos(angle)), upload(np.sin(angle))


class Part:
    """Texels and coefficients of some maps, and the matrix that makes the coefficients of other maps."""

    def __init__(self, shapes: Shapes, matrix: csc_matrix, turns: int) -> None:
        self.turns = turns
        rows, analysed, synthesised, first = matrix.tocsr(), [], [], 0
        for texel, h in shapes:
            unit = turns // (4 * h)
            m, i = np.divmod(np.arange(h * (h + 1)), h)
            analysed.append([texel + 2 * h * i, 1 + 0 * i, 2 * h + 0 * i, unit * m, 2 * unit * m])
            i, j = np.divmod(np.arange(2 * h * h), 2 * h)
            synthesised.append([first + i, h + 0 * i, h + 1 + 0 * i, 0 * i, unit * (2 * j + 1)])
            first += h * (h + 1)
        self.to_coefficients, self.to_texels = (
            Terms(*(upload(x, mi.UInt32) for x in np.hstack(part))) for part in (analysed, synthesised)
        )
        self.row_ends, self.columns = (upload(x, mi.UInt32) for x in (rows.indptr, rows.indices))
        self.weights = upload(rows.data)

    def analyse(self, texels: Float) -> Float:
        """Coefficients of texels."""

        def add(sums: list[Float], place: UInt32, cosine: Float, sine: Float) -> list[Float]:
            rgb = _packet(texels, place, TEXEL)[:3]
            real = [dr.fma(x, cosine, total) for x, total in zip(rgb, sums[:3], strict=True)]
            return real + [dr.fma(-x, sine, total) for x, total in zip(rgb, sums[3:], strict=True)]

        return _stored(self.to_coefficients.sums(6, self.turns, add))

    def product(self, coefficients: Float) -> Float:
        """The matrix times coefficients of other maps: coefficients of these."""
        row = dr.arange(mi.UInt32, dr.width(self.row_ends) - 1)

        def body(n: UInt32, sums: list[Float]) -> Any:
            weight = dr.gather(mi.Float, self.weights, n)
            values = _packet(coefficients, dr.gather(mi.UInt32, self.columns, n), COEFFICIENT)
            values = values[:3] + values[4:7]
            return n + 1, [dr.fma(weight, x, total) for x, total in zip(values, sums, strict=True)]

        end = dr.gather(mi.UInt32, self.row_ends, row + 1)
        start = (dr.gather(mi.UInt32, self.row_ends, row), [mi.Float(0)] * 6)
        return _stored(dr.while_loop(start, lambda n, sums: n < end, body, label="prefilter")[-1])

    def synthesise(self, coefficients: Float) -> list[Float]:
        """RGB of texels."""

        def add(sums: list[Float], place: UInt32, cosine: Float, sine: Float) -> list[Float]:
            c = _packet(coefficients, place, COEFFICIENT)
            real = [dr.fma(x, cosine, total) for x, total in zip(c[:3], sums, strict=True)]
            return [dr.fma(-x, sine, total) for x, total in zip(c[4:7], real, strict=True)]

        return self.to_texels.sums(3, self.turns, add)


def _packet(values: Float, place: UInt32, size: int) -> list[Float]:
    return list(dr.gather(mi.ArrayXf, values, place, shape=(size, dr.width(place))))


def _stored(sums: list[Float]) -> Float:
    """Coefficients in memory."""
    zero, count = mi.Float(0), dr.width(sums)
    stored = dr.empty(mi.Float, count * COEFFICIENT)
    value = mi.ArrayXf([*sums[:3], zero, *sums[3:], zero])
    dr.scatter(stored, value, dr.arange(mi.UInt32, count), mode=dr.ReduceMode.NoConflicts)
    return stored


class Kernels:
    """Those of an operator: the map, and its levels."""

    def __init__(self, height: int, shapes: Shapes, matrix: csc_matrix, texels: int) -> None:
        self.texels = texels
        self.map = Part([(0, height)], matrix.T, 4 * height)  # its product is with the transposed matrix
        self.levels = Part(shapes[1:], matrix, 4 * height)

    def apply(self, radiance: Float) -> Float:
        """As `Operator.apply`, of flat arrays."""
        levels = dr.zeros(mi.Float, self.texels * TEXEL)
        first = dr.width(radiance) // 3

        def write(rgb: list[Float], place: UInt32) -> None:
            dr.scatter(levels, mi.ArrayXf([*rgb, mi.Float(0)]), place, mode=dr.ReduceMode.NoConflicts)

        texel = dr.arange(mi.UInt32, first)
        write([dr.gather(mi.Float, radiance, 3 * texel + k) for k in range(3)], texel)
        filtered = self.levels.synthesise(self.levels.product(self.map.analyse(levels)))
        write(filtered, dr.arange(mi.UInt32, self.texels - first) + first)
        return levels

    def apply_transposed(self, δlevels: Float) -> Float:
        """As `Operator.apply_transposed`, of flat arrays."""
        filtered = self.map.synthesise(self.map.product(self.levels.analyse(δlevels)))
        δmap = _packet(δlevels, dr.arange(mi.UInt32, dr.width(filtered)), TEXEL)[:3]
        return dr.ravel(mi.Color3f(*(a + b for a, b in zip(filtered, δmap, strict=True))))
