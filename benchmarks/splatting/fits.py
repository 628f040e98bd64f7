"""Time and memory as sums of what they grow with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import nnls

Row = dict[str, Any]


def plane(rows: Sequence[Row], target: str, names: Sequence[str]) -> dict[str, float]:
    """row[target] = constant + Σ c row[name], no coefficient negative; R², and the worst relative residual.

    Squares of relative residuals are summed, so that small cases count as much as large ones.
    """
    values = np.array([float(row[target]) for row in rows])
    design = np.array([[1.0, *(float(row[name]) for name in names)] for row in rows])
    scale = design.max(axis=0)  # keeps the solver's columns of one size
    solution, _ = nnls(design / scale / values[:, None], np.ones(len(rows)))
    found = solution / scale
    residual = design @ found - values
    return {
        "constant": float(found[0]),
        **{name: float(value) for name, value in zip(names, found[1:], strict=True)},
        "r2": 1 - float(np.sum(residual**2) / np.sum((values - values.mean()) ** 2)),
        "worst": float(np.abs(residual / values).max()),
    }
