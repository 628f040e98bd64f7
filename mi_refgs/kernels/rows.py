"""Rows of floats, read and written in a few wide accesses per row, not in one per column; their columns under
AD; and arrays one after the other."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.linear import linear
from mi_refgs.types import Bool, Float, UInt32

ACCESS = 8  # floats per access: Dr.Jit's LLVM code splits wider ones
COPIES_BYTES = 1 << 30  # most memory for copies per thread in `PackedRows.add`; above, additions are atomic


@dataclass(frozen=True)
class PackedRows:
    """N rows of `width` floats, each padded with zeros to whole accesses; no derivative."""

    data: Float  # (N · accesses · access,)
    count: int
    width: int
    access: int = ACCESS

    @property
    def accesses(self) -> int:
        """Accesses per row."""
        return -(-self.width // self.access)

    @staticmethod
    def zeros(count: int, width: int) -> "PackedRows":
        """Rows of zeros."""
        return PackedRows(dr.zeros(mi.Float, count * -(-width // ACCESS) * ACCESS), count, width)

    @staticmethod
    def pack(columns: list[Float], access: int = ACCESS) -> "PackedRows":
        """Pack columns (N,)."""
        count, width = dr.width(columns[0]), len(columns)
        rows = PackedRows(dr.empty(mi.Float, count * -(-width // access) * access), count, width, access)
        values = [dr.detach(column) for column in columns]
        for place, group in rows._groups(dr.arange(mi.UInt32, count), values):
            # Without the promise of no conflicts every group would be a kernel of its own.
            dr.scatter(rows.data, group, place, mode=dr.ReduceMode.NoConflicts)
        return rows

    def columns(self) -> list[Float]:
        """Columns (N,)."""
        return self.fetch(dr.arange(mi.UInt32, self.count))[: self.width]

    def fetch(self, row: UInt32, active: Bool = True) -> list[Float]:
        """Values of rows, one array per column, then per column of the padding."""
        shape = (self.access, dr.width(row))
        places = [row * self.accesses + i for i in range(self.accesses)]
        groups = [dr.gather(mi.ArrayXf, self.data, place, active, shape=shape) for place in places]
        return [value for group in groups for value in group]

    def add(self, row: UInt32, values: list[Float], active: Bool) -> None:
        """Add values, one array per column, to rows; on the CPU by copies per thread within COPIES_BYTES."""
        # Dr.Jit itself always adds atomically to more than a million entries.
        copies = 4 * dr.width(self.data) * dr.thread_count()
        mode = dr.ReduceMode.Expand if copies <= COPIES_BYTES else dr.ReduceMode.Local
        if dr.backend_v(self.data) == dr.JitBackend.CUDA:
            mode = dr.ReduceMode.Direct  # `Local` takes twice as long, `Expand` eight times: docs/gpu.md
        for place, group in self._groups(row, values):
            dr.scatter_add(self.data, group, place, active, mode=mode)

    def _groups(self, row: UInt32, values: list[Float]) -> list[tuple[UInt32, Any]]:
        padded = values + [mi.Float(0)] * (-len(values) % self.access)
        groups = [padded[i : i + self.access] for i in range(0, len(padded), self.access)]
        return [(row * self.accesses + i, mi.ArrayXf(group)) for i, group in enumerate(groups)]


def columns_of(array: Float, width: int) -> list[Float]:
    """Columns (N,) of N · width floats without padding, under AD. Their adjoint is computed in memory of its
    own: a gather's would be lost where other terms write to `array` in another mode."""
    return list(linear(array, partial(_split, width), partial(_join, width)))


def _split(width: int, array: Float) -> list[Float]:
    return PackedRows(array, dr.width(array) // width, width, math.gcd(width, ACCESS)).columns()


def _join(width: int, columns: list[Float]) -> Float:
    if width == 1:
        return columns[0]
    access = math.gcd(width, ACCESS)
    # To write column by column, 16 cache lines each time, takes four times as long.
    packed = PackedRows.pack(columns, ACCESS if access == 1 and width > ACCESS else access)
    dr.eval(packed.data)  # it may become the gradient itself, which others write into
    padded = packed.accesses * packed.access
    if padded == width:
        return packed.data
    entry = dr.arange(mi.UInt32, packed.count * width)
    row = entry // width
    return dr.gather(mi.Float, packed.data, row * padded + (entry - row * width))


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
