"""Columns of a table of rows, and tables one after the other, under AD."""

from __future__ import annotations

import math
from functools import partial

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.linear import linear
from mi_refgs.types import Float

ACCESS = 8  # floats per access: Dr.Jit's LLVM code splits wider ones


def columns_of(array: Float, width: int) -> list[Float]:
    """Columns (N,) of N · width floats without padding, under AD. Their adjoint is computed in memory of its
    own: a gather's would be lost where other terms write to `array` in another mode."""
    return list(linear(array, partial(_split, width), partial(_join, width)))


def _split(width: int, array: Float) -> list[Float]:
    access = math.gcd(width, ACCESS)
    count, accesses = dr.width(array) // width, width // access
    row = dr.arange(mi.UInt32, count) * accesses
    if access == 1:
        return [dr.gather(mi.Float, array, row + i) for i in range(width)]
    shape = (access, count)
    return [x for i in range(accesses) for x in dr.gather(mi.ArrayXf, array, row + i, shape=shape)]


def _join(width: int, columns: list[Float]) -> Float:
    if width == 1:
        return columns[0]
    size = math.gcd(width, ACCESS)
    if size == 1 and width > ACCESS:
        # To write column by column, 16 cache lines each time, takes four times as long.
        size, columns = ACCESS, columns + [mi.Float(0)] * (-width % ACCESS)
    count, accesses = dr.width(columns), len(columns) // size
    flat, row = dr.empty(mi.Float, count * len(columns)), dr.arange(mi.UInt32, count) * accesses
    for i in range(accesses):
        group = columns[i * size : (i + 1) * size]
        value = group[0] if size == 1 else mi.ArrayXf(group)
        # Without the promise of no conflicts every group would be a kernel of its own.
        dr.scatter(flat, value, row + i, mode=dr.ReduceMode.NoConflicts)
    dr.eval(flat)  # it may become the gradient itself, which others write into
    if len(columns) == width:
        return flat
    entry = dr.arange(mi.UInt32, count * width)
    row = entry // width
    return dr.gather(mi.Float, flat, row * len(columns) + (entry - row * width))


def joined(first: list[Float], second: list[Float]) -> list[Float]:
    """Concatenate the arrays of two lists pair by pair, under AD; the adjoints have memory of their own. One
    kernel per distinct width that is read."""
    widths = [[dr.width(array) for array in part] for part in (first, second)]

    def concatenated(parts: tuple[list[Float], list[Float]]) -> list[Float]:
        out, promise = [], dr.ReduceMode.NoConflicts  # without it every array would be a kernel of its own
        for a, b, width, other in zip(*parts, *widths, strict=True):
            whole, begin = dr.empty(mi.Float, width + other), dr.opaque(mi.UInt32, width)
            dr.scatter(whole, dr.detach(a), dr.arange(mi.UInt32, width), mode=promise)
            dr.scatter(whole, dr.detach(b), dr.arange(mi.UInt32, other) + begin, mode=promise)
            out.append(whole)
        dr.eval(out)
        return out

    def parted(whole: list[Float]) -> tuple[list[Float], ...]:
        dr.eval(whole)
        starts = [mi.UInt32(0)] * len(whole), [dr.opaque(mi.UInt32, width) for width in widths[0]]
        parts = []
        for own, start in zip(widths, starts, strict=True):
            places = [dr.arange(mi.UInt32, width) + begin for width, begin in zip(own, start, strict=True)]
            parts.append([dr.gather(mi.Float, x, place) for x, place in zip(whole, places, strict=True)])
        return tuple(parts)

    return list(linear((first, second), concatenated, parted))
