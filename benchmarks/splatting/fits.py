"""Straight lines through times and memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import nnls

Row = dict[str, Any]


def line(x: Sequence[float], y: Sequence[float]) -> dict[str, float]:
    """Least squares y = a + b x, with R² = 1 - Σ residual² / Σ (y - mean)², and the decades that x spans."""
    design = np.stack([np.ones(len(x)), np.asarray(x, float)], axis=1)
    values = np.asarray(y, float)
    solution, *_ = np.linalg.lstsq(design, values, rcond=None)
    residual = values - design @ solution
    spread = float(np.sum((values - values.mean()) ** 2))
    return {
        "a": float(solution[0]),
        "b": float(solution[1]),
        "r2": 1 - float(np.sum(residual**2)) / spread if spread else 1.0,
        "decades": float(np.log10(max(x) / min(x))),
        "points": len(x),
    }


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
