"""Steps that change nothing because their loss or a gradient is not finite.

The device decides, and the host does not wait for it: `Skips.report` says later how many there were and which
rows had such gradients.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.fitting.rates import Group

WIDE_ROW = 64
"""Columns beyond which rows are not told apart: harmonics have 48, a row of the light hundreds."""

WORD = 32
"""Tensors whose bits fit one integer of the marks."""

MEMORY = 4096
"""Steps that `report` may come late."""


@dataclass(frozen=True)
class Skipped:
    """Steps that changed nothing since the last report."""

    count: int
    iteration: int  # 0-based, of the last one
    rows: dict[str, np.ndarray]  # rows whose gradient was not finite, by tensor; absent where there was none


class Skips:
    """Looks at the gradients of each step, and remembers the steps that must change nothing.

    `params` and `groups` are those of the optimiser: tensors and learning rates by name.
    """

    def __init__(self, params: Mapping[str, Any], groups: Mapping[str, Group]) -> None:
        self._params, self._groups = params, groups
        # By number of rows and word w, (rows,): bit b where a gradient of group WORD w + b was not finite.
        self._marks: dict[tuple[int, int], Any] = {}
        self._calls, self._iteration = 0, 0  # number and iteration of the last step
        self._reported = 0  # number of the last step that was reported
        # At the number of a step modulo MEMORY: that number, if the step was skipped.
        self._skipped = dr.opaque(mi.UInt32, 0, MEMORY)

    def good(self, gradients: Mapping[str, Any], iteration: int, loss: Any = None) -> Any:
        """Whether the step may be taken (mi.Bool of width 1), by its `loss` (mi.Float) and gradients."""
        self._calls, self._iteration = self._calls + 1, iteration
        number, place = dr.opaque(mi.UInt32, self._calls), dr.opaque(mi.UInt32, self._calls % MEMORY)
        for skip in self._not_finite(gradients):
            if loss is not None:
                skip |= ~dr.isfinite(loss)
            # Almost never active, so it costs nothing.
            dr.scatter(self._skipped, number, place, skip)
        dr.eval(self._skipped, self._marks)
        return dr.gather(mi.UInt32, self._skipped, place) != number

    def report(self) -> Skipped:
        """The steps that were skipped since the last call; waits for the device, so not for every step."""
        skipped = self._skipped.numpy()
        skipped = skipped[skipped > self._reported]
        rows = {}
        for i, name in enumerate(self._groups if len(skipped) else ()):
            marks = self._marks.get((self._marked(name), i // WORD))
            found = np.zeros(0, np.uint32) if marks is None else marks.numpy()
            rows[name] = np.flatnonzero(found >> np.uint32(i % WORD) & 1)
        last = self._iteration - (self._calls - int(skipped.max(initial=0)))
        self._reported = self._calls
        if len(skipped):
            self._marks.clear()
        return Skipped(len(skipped), last, {name: at for name, at in rows.items() if len(at)})

    def forget_rows(self) -> None:
        """Forget which rows had such gradients: rows have moved."""
        self._marks.clear()

    def _marked(self, name: str) -> int:
        """Rows of the marks that a tensor shares with others; 1 for one of wide rows, not told apart."""
        rows, width = int(self._params[name].shape[0]), math.prod(self._params[name].shape[1:])
        return rows if width <= WIDE_ROW else 1

    def _not_finite(self, gradients: Mapping[str, Any]) -> list[Any]:
        """Where something is not finite (mi.Bool), by rows or by entries; rows get the bit of each group.

        One look at a row serves all of its tensors. Only head columns are looked at: the others are of
        spherical harmonics, whose gradient is that of a head column times a bounded function.
        """
        by_entry: list[Any] = []
        by_row: dict[tuple[int, int], Any] = {}
        for i, name in enumerate(self._groups):
            if name not in gradients:
                continue
            g, rows, bit = gradients[name], self._marked(name), mi.UInt32(1 << i % WORD)
            key = rows, i // WORD
            self._marks.setdefault(key, dr.opaque(mi.UInt32, 0, rows))
            if rows == 1:
                bad = ~dr.isfinite(g)
                dr.scatter_reduce(dr.ReduceOp.Or, self._marks[key], bit, 0, bad, dr.ReduceMode.Direct)
                by_entry.append(bad)
                continue
            width = dr.width(g) // rows
            first = dr.arange(mi.UInt32, rows) * width
            columns = [dr.gather(mi.Float, g, first + c) for c in range(self._groups[name].head or width)]
            found = dr.select(reduce(operator.and_, map(dr.isfinite, columns)), mi.UInt32(0), bit)
            by_row[key] = by_row.get(key, mi.UInt32(0)) | found
        for key, found in by_row.items():
            self._marks[key] |= found
        return by_entry + [found != 0 for found in by_row.values()]
