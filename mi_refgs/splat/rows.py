"""Rows of floats, read and written in a few wide accesses per row, not in one per column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.rows import ACCESS
from mi_refgs.types import Bool, Float, UInt32

COPIES_BYTES = 1 << 30  # most memory for copies per thread in `PackedRows.add`; above, additions are atomic


@dataclass(frozen=True)
class PackedRows:
    """N rows of `width` floats, each padded with zeros to whole accesses; no derivative."""

    data: Float  # (N · accesses · ACCESS,)
    count: int
    width: int

    @property
    def accesses(self) -> int:
        """Accesses per row."""
        return -(-self.width // ACCESS)

    @staticmethod
    def zeros(count: int, width: int) -> PackedRows:
        """Rows of zeros."""
        return PackedRows(dr.zeros(mi.Float, count * -(-width // ACCESS) * ACCESS), count, width)

    @staticmethod
    def pack(columns: list[Float]) -> PackedRows:
        """Pack columns (N,)."""
        count, width = dr.width(columns[0]), len(columns)
        rows = PackedRows(dr.empty(mi.Float, count * -(-width // ACCESS) * ACCESS), count, width)
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
        shape = (ACCESS, dr.width(row))
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
        padded = values + [mi.Float(0)] * (self.accesses * ACCESS - len(values))
        groups = [padded[i : i + ACCESS] for i in range(0, len(padded), ACCESS)]
        return [(row * self.accesses + i, mi.ArrayXf(group)) for i, group in enumerate(groups)]
