"""Errors of outgoing radiance against a reference that carries its own standard error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.common.montecarlo import Estimate
from mi_refgs.evaluation import metrics
from mi_refgs.io.images import srgb_from_linear

DARK = 0.01
"""Share of the mean radiance below which a relative error counts as one of this radiance."""
CLEAR = 2.0
"""A relMSE below this many times what the reference's own noise adds to it is not told from zero."""


@dataclass(frozen=True)
class Errors:
    """Of one picture; each with the floor that the reference's noise sets.

    bias: mean signed error over mean radiance; relmse: mean of (x - ref)² / (ref² + ε), ε = (0.01 mean)²;
    mape: mean of |x - ref| / (ref + 0.01 mean).
    """

    bias: float
    relmse: float
    mape: float
    bias_floor: float
    relmse_floor: float

    @property
    def below_floor(self) -> bool:
        """Whether relMSE cannot be told from the reference's noise."""
        return self.relmse < CLEAR * self.relmse_floor

    def record(self) -> dict[str, Any]:
        """For CSV and JSON."""
        return vars(self) | {"below_floor": self.below_floor}


def weight(reference: np.ndarray, scale: float | None = None) -> np.ndarray:
    """1 / (ref² + ε), the weight of squared errors; `scale` replaces the mean of `reference` in ε."""
    mean = float(reference.mean()) if scale is None else scale
    return 1 / (reference**2 + (DARK * mean) ** 2)


def compare(values: np.ndarray, reference: Estimate, where: np.ndarray | None = None) -> Errors:
    """Errors of (P, 3) values, over all points or those of a mask (P,)."""
    scale = float(reference.mean.mean())
    chosen = np.ones(len(values), bool) if where is None else where
    x, mean, noise = values[chosen], reference.mean[chosen], reference.error[chosen]
    w = weight(mean, scale)
    return Errors(
        bias=float((x - mean).mean() / mean.mean()),
        relmse=float(((x - mean) ** 2 * w).mean()),
        mape=float((np.abs(x - mean) / (mean + DARK * scale)).mean()),
        bias_floor=float(np.sqrt((noise**2).sum()) / noise.size / mean.mean()),
        relmse_floor=float((noise**2 * w).mean()),
    )


def flip(picture: np.ndarray, truth: np.ndarray) -> tuple[float | None, str]:
    """(Mean LDR FLIP, "") of linear pictures, exposed so that the true mean is ½; or (None, why)."""
    lit = truth[truth > 0]
    exposure = 0.5 / float(lit.mean())
    return metrics.flip(srgb_from_linear(picture * exposure), srgb_from_linear(truth * exposure))


def mean_score(values: np.ndarray, reference: Estimate) -> float:
    """Mean error in its own standard errors, seen from the scatter over points (P, 3).

    Standard normal for an unbiased renderer, whatever it renders; the colours of a point count as one.
    """
    difference = ((values - reference.mean) * np.sqrt(weight(reference.mean))).sum(-1)
    return float(difference.sum() / np.sqrt((difference**2).sum()))
