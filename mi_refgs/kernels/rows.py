"""Columns of a table of rows, and tables one after the other, under AD."""

from __future__ import annotations

import math

import drjit as dr
import mitsuba as mi

from mi_refgs.types import Float

ACCESS = 8  # floats per access: Dr.Jit's LLVM code splits wider ones


def columns_of(array: Float, width: int) -> list[Float]:
    """Columns (N,) of N · width floats without padding, under AD. Their adjoint is computed in memory of its
    own: a gather's would be lost where other terms write to `array` in another mode."""
    return list(dr.custom(_Columns, array, width))


class _Columns(dr.CustomOp):
    """Flat rows → columns."""

    def eval(self, array: Float, width: int) -> list[Float]:
        self.width = width
        return self._split(array)

    def forward(self) -> None:
        self.set_grad_out(self._split(self.grad_in("array")))

    def backward(self) -> None:
        self.set_grad_in("array", self._join(self.grad_out()))

    def name(self) -> str:
        return "columns"

    def _split(self, array: Float) -> list[Float]:
        access = math.gcd(self.width, ACCESS)
        count, accesses = dr.width(array) // self.width, self.width // access
        row = dr.arange(mi.UInt32, count) * accesses
        if access == 1:
            return [dr.gather(mi.Float, array, row + i) for i in range(self.width)]
        shape = (access, count)
        return [x for i in range(accesses) for x in dr.gather(mi.ArrayXf, array, row + i, shape=shape)]

    def _join(self, columns: list[Float]) -> Float:
        if self.width == 1:
            return columns[0]
        size = math.gcd(self.width, ACCESS)
        if size == 1 and self.width > ACCESS:
            # To write column by column, 16 cache lines each time, takes four times as long.
            size, columns = ACCESS, columns + [mi.Float(0)] * (-self.width % ACCESS)
        count, accesses = dr.width(columns), len(columns) // size
        flat, row = dr.empty(mi.Float, count * len(columns)), dr.arange(mi.UInt32, count) * accesses
        for i in range(accesses):
            group = columns[i * size : (i + 1) * size]
            value = group[0] if size == 1 else mi.ArrayXf(group)
            # Without the promise of no conflicts every group would be a kernel of its own.
            dr.scatter(flat, value, row + i, mode=dr.ReduceMode.NoConflicts)
        dr.eval(flat)  # it may become the gradient itself, which others write into
        if len(columns) == self.width:
            return flat
        entry = dr.arange(mi.UInt32, count * self.width)
        row = entry // self.width
        return dr.gather(mi.Float, flat, row * len(columns) + (entry - row * self.width))


def joined(first: list[Float], second: list[Float]) -> list[Float]:
    """Concatenate the arrays of two lists pair by pair, under AD; the adjoints have memory of their own."""
    return list(dr.custom(_Joined, first, second))


class _Joined(dr.CustomOp):
    """Two lists of arrays → a list of concatenated ones; one kernel per distinct width that is read."""

    def eval(self, first: list[Float], second: list[Float]) -> list[Float]:
        self.widths = [[dr.width(array) for array in part] for part in (first, second)]
        return self._join(first, second)

    def forward(self) -> None:
        self.set_grad_out(self._join(self.grad_in("first"), self.grad_in("second")))

    def backward(self) -> None:
        δout = self.grad_out()
        dr.eval(δout)
        starts = [[mi.UInt32(0)] * len(δout), [dr.opaque(mi.UInt32, width) for width in self.widths[0]]]
        for name, widths, start in zip(("first", "second"), self.widths, starts, strict=True):
            places = [dr.arange(mi.UInt32, width) + begin for width, begin in zip(widths, start, strict=True)]
            self.set_grad_in(
                name, [dr.gather(mi.Float, δ, place) for δ, place in zip(δout, places, strict=True)]
            )

    def name(self) -> str:
        return "joined"

    def _join(self, first: list[Float], second: list[Float]) -> list[Float]:
        out, promise = [], dr.ReduceMode.NoConflicts  # without it every array would be a kernel of its own
        for a, b, width, other in zip(first, second, *self.widths, strict=True):
            whole, begin = dr.empty(mi.Float, width + other), dr.opaque(mi.UInt32, width)
            dr.scatter(whole, dr.detach(a), dr.arange(mi.UInt32, width), mode=promise)
            dr.scatter(whole, dr.detach(b), dr.arange(mi.UInt32, other) + begin, mode=promise)
            out.append(whole)
        dr.eval(out)
        return out
