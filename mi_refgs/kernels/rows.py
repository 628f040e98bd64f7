"""Tables by rows, read and written in packets: a row is then a few wide memory accesses, not one a column."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

PACKET = 8
"""Floats that one access moves: Dr.Jit's LLVM code for wider packets is made of these."""

COPIES_BYTES = 1 << 30
"""Most memory of the copies that `PackedRows.add` makes, one a thread; above it adds atomically. A gradient
of a million surfels with 14 features, 24 floats a row, has 96 MB a copy: up to 11 threads have one each."""


@dataclass(frozen=True)
class PackedRows:
    """N rows of `width` floats, each padded with zeros to whole packets; no derivative."""

    data: Any  # mi.Float (N · packets · PACKET,)
    count: int
    width: int

    @property
    def packets(self) -> int:
        """Packets per row."""
        return _padded(self.width) // PACKET

    @staticmethod
    def zeros(count: int, width: int) -> PackedRows:
        """PackedRows of zeros."""
        return PackedRows(dr.zeros(mi.Float, count * _padded(width)), count, width)

    @staticmethod
    def pack(columns: list[Any]) -> PackedRows:
        """PackedRows of columns (mi.Float, width N)."""
        count, width = dr.width(columns[0]), len(columns)
        rows = PackedRows(dr.empty(mi.Float, count * _padded(width)), count, width)
        values = [dr.detach(column) for column in columns]
        for place, packet in rows._packets(dr.arange(mi.UInt32, count), values):
            # Without the promise of no conflicts every packet would be a kernel of its own.
            dr.scatter(rows.data, packet, place, mode=dr.ReduceMode.NoConflicts)
        return rows

    def columns(self) -> list[Any]:
        """Columns (mi.Float, width N)."""
        return self.fetch(dr.arange(mi.UInt32, self.count))[: self.width]

    def unpadded(self) -> Any:
        """The rows without their padding, mi.Float (N · width,)."""
        entry = dr.arange(mi.UInt32, self.count * self.width)
        row = entry // self.width
        return dr.gather(mi.Float, self.data, row * (self.packets * PACKET) + (entry - row * self.width))

    def fetch(self, row: Any, active: Any = True) -> list[Any]:
        """Values of rows (mi.UInt32, any width): a mi.Float for each column, then for the padding."""
        shape = (PACKET, dr.width(row))
        places = [row * self.packets + i for i in range(self.packets)]
        packets = [dr.gather(mi.ArrayXf, self.data, place, active, shape=shape) for place in places]
        return [value for packet in packets for value in packet]

    def add(self, row: Any, values: list[Any], active: Any) -> None:
        """Add values, one for each column, to rows.

        On the CPU each thread has a copy of the rows until they are read, of COPIES_BYTES in all at most.
        """
        # Dr.Jit's own choice for a table of more than a million entries is atomic, whatever the threads.
        copies = 4 * dr.width(self.data) * dr.thread_count()
        mode = dr.ReduceMode.Expand if copies <= COPIES_BYTES else dr.ReduceMode.Local
        for place, packet in self._packets(row, values):
            dr.scatter_add(self.data, packet, place, active, mode=mode)

    def _packets(self, row: Any, values: list[Any]) -> list[tuple[Any, Any]]:
        padded = values + [mi.Float(0)] * (self.packets * PACKET - len(values))
        groups = [padded[i : i + PACKET] for i in range(0, len(padded), PACKET)]
        return [(row * self.packets + i, mi.ArrayXf(group)) for i, group in enumerate(groups)]


def _padded(width: int) -> int:
    """Floats of a row with its padding."""
    return -(-width // PACKET) * PACKET


def columns_of(array: Any, width: int) -> list[Any]:
    """Columns (mi.Float, width N) of N · width floats without padding, under AD.

    The adjoint is made in memory of its own and then added to that of `array`. The adjoint of a gather would
    write into the gradient of `array` itself, where other terms of a loss write too, in another mode: what
    one of them has written is then lost.
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
    def packet(self) -> int:
        """Floats that one access moves: the widest packet that divides a row."""
        return math.gcd(self.width, PACKET)

    def _split(self, array: Any) -> list[Any]:
        count, packets = dr.width(array) // self.width, self.width // self.packet
        row = dr.arange(mi.UInt32, count) * packets
        if self.packet == 1:
            return [dr.gather(mi.Float, array, row + i) for i in range(self.width)]
        shape = (self.packet, count)
        return [x for i in range(packets) for x in dr.gather(mi.ArrayXf, array, row + i, shape=shape)]

    def _join(self, columns: list[Any]) -> Any:
        if self.width == 1:
            return columns[0]
        if self.packet == 1 and self.width > PACKET:
            # To write column by column, 16 cache lines each time, takes four times as long.
            return PackedRows.pack(columns).unpadded()
        count, packets = dr.width(columns), self.width // self.packet
        flat, row = dr.empty(mi.Float, count * self.width), dr.arange(mi.UInt32, count) * packets
        for i in range(packets):
            group = columns[i * self.packet : (i + 1) * self.packet]
            value = group[0] if self.packet == 1 else mi.ArrayXf(group)
            # Without the promise of no conflicts every packet would be a kernel of its own.
            dr.scatter(flat, value, row + i, mode=dr.ReduceMode.NoConflicts)
        dr.eval(flat)  # it may become the gradient itself, which others write into
        return flat


def joined(first: list[Any], second: list[Any]) -> list[Any]:
    """Each mi.Float of `first` with that of `second` after it, under AD; both lists are of one length.

    The adjoints go to arrays of their own, so that nothing else that reads an input writes there too.
    """
    return list(dr.custom(_Joined, first, second))


class _Joined(dr.CustomOp):
    """Two lists of arrays → a list of longer ones; one kernel for each distinct width that is read."""

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
