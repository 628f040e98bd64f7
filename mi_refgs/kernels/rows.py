"""Rows of floats, read and written in a few wide accesses per row, not in one per column."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.types import Float

ACCESS = 8
"""Floats per access: Dr.Jit's LLVM code splits wider ones into these."""

COPIES_BYTES = 1 << 30
"""Largest memory of the copies per thread that `PackedRows.add` makes; above it, additions are atomic. The
gradient of a million surfels with 14 features, 24 floats per row, has 96 MB per copy: 11 threads fit."""


@dataclass(frozen=True)
class PackedRows:
    """N rows of `width` floats, each padded with zeros to whole accesses; no derivative."""

    data: Float  # (N · accesses · ACCESS,)
    count: int
    width: int

    @property
    def accesses(self) -> int:
        """Accesses per row."""
        return _padded(self.width) // ACCESS

    @staticmethod
    def zeros(count: int, width: int) -> PackedRows:
        """Rows of zeros."""
        return PackedRows(dr.zeros(mi.Float, count * _padded(width)), count, width)

    @staticmethod
    def pack(columns: list[Any]) -> PackedRows:
        """Pack columns (N,)."""
        count, width = dr.width(columns[0]), len(columns)
        rows = PackedRows(dr.empty(mi.Float, count * _padded(width)), count, width)
        values = [dr.detach(column) for column in columns]
        for place, group in rows._groups(dr.arange(mi.UInt32, count), values):
            # Without the promise of no conflicts every group would be a kernel of its own.
            dr.scatter(rows.data, group, place, mode=dr.ReduceMode.NoConflicts)
        return rows

    def columns(self) -> list[Any]:
        """Columns (N,)."""
        return self.fetch(dr.arange(mi.UInt32, self.count))[: self.width]

    def unpadded(self) -> Any:
        """The rows without their padding, (N · width,)."""
        entry = dr.arange(mi.UInt32, self.count * self.width)
        row = entry // self.width
        return dr.gather(mi.Float, self.data, row * (self.accesses * ACCESS) + (entry - row * self.width))

    def fetch(self, row: Any, active: Any = True) -> list[Any]:
        """Values of rows, one array per column, then per column of the padding."""
        shape = (ACCESS, dr.width(row))
        places = [row * self.accesses + i for i in range(self.accesses)]
        groups = [dr.gather(mi.ArrayXf, self.data, place, active, shape=shape) for place in places]
        return [value for group in groups for value in group]

    def add(self, row: Any, values: list[Any], active: Any) -> None:
        """Add values, one array per column, to rows.

        On the CPU each thread has a copy until the rows are read, if all copies fit into COPIES_BYTES.
        """
        # Dr.Jit itself always adds atomically to more than a million entries.
        copies = 4 * dr.width(self.data) * dr.thread_count()
        mode = dr.ReduceMode.Expand if copies <= COPIES_BYTES else dr.ReduceMode.Local
        for place, group in self._groups(row, values):
            dr.scatter_add(self.data, group, place, active, mode=mode)

    def _groups(self, row: Any, values: list[Any]) -> list[tuple[Any, Any]]:
        padded = values + [mi.Float(0)] * (self.accesses * ACCESS - len(values))
        groups = [padded[i : i + ACCESS] for i in range(0, len(padded), ACCESS)]
        return [(row * self.accesses + i, mi.ArrayXf(group)) for i, group in enumerate(groups)]


def _padded(width: int) -> int:
    """Floats of a row with its padding."""
    return -(-width // ACCESS) * ACCESS


def columns_of(array: Any, width: int) -> list[Any]:
    """Columns (N,) of N · width floats without padding, under AD.

    The adjoint is computed in memory of its own and then added to that of `array`. The adjoint of a gather
    would write into the gradient of `array` itself, where other terms of a loss write in another mode: one of
    the two would be lost.
    """
    return list(dr.custom(_Columns, array, width))


class _Columns(dr.CustomOp):
    """Flat rows → columns."""

    def eval(self, array: Any, width: int) -> list[Any]:
        self.width = width
        return self._split(array)

    def forward(self) -> None:
        self.set_grad_out(self._split(self.grad_in("array")))

    def backward(self) -> None:
        self.set_grad_in("array", self._join(self.grad_out()))

    def name(self) -> str:
        return "columns"

    @property
    def access(self) -> int:
        """Floats per access: the most that divide a row."""
        return math.gcd(self.width, ACCESS)

    def _split(self, array: Any) -> list[Any]:
        count, accesses = dr.width(array) // self.width, self.width // self.access
        row = dr.arange(mi.UInt32, count) * accesses
        if self.access == 1:
            return [dr.gather(mi.Float, array, row + i) for i in range(self.width)]
        shape = (self.access, count)
        return [x for i in range(accesses) for x in dr.gather(mi.ArrayXf, array, row + i, shape=shape)]

    def _join(self, columns: list[Any]) -> Any:
        if self.width == 1:
            return columns[0]
        if self.access == 1 and self.width > ACCESS:
            # To write column by column, 16 cache lines each time, takes four times as long.
            return PackedRows.pack(columns).unpadded()
        count, accesses = dr.width(columns), self.width // self.access
        flat, row = dr.empty(mi.Float, count * self.width), dr.arange(mi.UInt32, count) * accesses
        for i in range(accesses):
            group = columns[i * self.access : (i + 1) * self.access]
            value = group[0] if self.access == 1 else mi.ArrayXf(group)
            # Without the promise of no conflicts every group would be a kernel of its own.
            dr.scatter(flat, value, row + i, mode=dr.ReduceMode.NoConflicts)
        dr.eval(flat)  # it may become the gradient itself, which others write into
        return flat


def joined(first: list[Any], second: list[Any]) -> list[Any]:
    """Concatenate the arrays of two lists pair by pair, under AD.

    The adjoints are arrays of their own, into which no other reader of the inputs writes.
    """
    return list(dr.custom(_Joined, first, second))


class _Joined(dr.CustomOp):
    """Two lists of arrays → a list of concatenated ones; one kernel per distinct width that is read."""

    def eval(self, first: list[Any], second: list[Any]) -> list[Any]:
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

    def _join(self, first: list[Any], second: list[Any]) -> list[Any]:
        out = []
        for a, b, width, other in zip(first, second, *self.widths, strict=True):
            whole = dr.empty(mi.Float, width + other)
            place, begin = dr.arange(mi.UInt32, width), dr.opaque(mi.UInt32, width)
            # Without the promise of no conflicts every array would be a kernel of its own.
            dr.scatter(whole, dr.detach(a), place, mode=dr.ReduceMode.NoConflicts)
            place = dr.arange(mi.UInt32, other) + begin
            dr.scatter(whole, dr.detach(b), place, mode=dr.ReduceMode.NoConflicts)
            out.append(whole)
        dr.eval(out)
        return out
