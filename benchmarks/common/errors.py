"""Errors of outgoing radiance against a reference with a standard error, and error budgets."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.common.montecarlo import Estimate
from benchmarks.common.report import Row

DARK = 0.01  # share of the mean radiance below which a relative error counts as one of this radiance
CLEAR = 2.0  # a relMSE below this many times what the reference's own noise adds to it is not told from zero


def weight(reference: np.ndarray, scale: float | None = None) -> np.ndarray:
    """1 / (ref² + ε), the weight of squared errors; `scale` replaces the mean of `reference` in ε."""
    mean = float(reference.mean()) if scale is None else scale
    return 1 / (reference**2 + (DARK * mean) ** 2)


def compare(values: np.ndarray, reference: Estimate, where: np.ndarray | None = None) -> Row:
    """Errors of (P, 3) values, over all points or those of a mask (P,), each with the floor of the noise.

    bias: mean signed error over mean radiance; relmse: mean of (x - ref)² / (ref² + ε), ε = (0.01 mean)²;
    below_floor: relMSE may be the reference's noise alone."""
    scale = float(reference.mean.mean())
    chosen = np.ones(len(values), bool) if where is None else where
    x, mean, noise = values[chosen], reference.mean[chosen], reference.error[chosen]
    w = weight(mean, scale)
    relmse, floor = float(((x - mean) ** 2 * w).mean()), float((noise**2 * w).mean())
    return {
        "bias": float((x - mean).mean() / mean.mean()),
        "relmse": relmse,
        "relmse_floor": floor,
        "below_floor": relmse < CLEAR * floor,
    }


def mean_score(values: np.ndarray, reference: Estimate) -> float:
    """Mean error in its own standard errors, seen from the scatter over points (P, 3).

    Standard normal for an unbiased renderer, whatever it renders; the colours of a point count as one."""
    difference = ((values - reference.mean) * np.sqrt(weight(reference.mean))).sum(-1)
    return float(difference.sum() / np.sqrt((difference**2).sum()))


class Step(NamedTuple):
    """An image (P, 3), and the approximation that it no longer makes ("" for the first)."""

    replaced: str
    values: np.ndarray


def decompose(steps: Sequence[Step]) -> Row:
    """Budget of a chain of at least two steps, the last of which is the reference.

    parts, in the order of the chain: relmse alone, and share of the total, the projection on the whole error
    e_k·e / e·e, negative where it cancels others."""
    reference = steps[-1].values
    root = np.sqrt(weight(reference))
    differences = [before.values - after.values for before, after in itertools.pairwise(steps)]
    scaled = np.stack([(difference * root).ravel() for difference in differences])
    products = scaled @ scaled.T / scaled.shape[1]
    total = float(products.sum())
    names = [step.replaced for step in steps[1:]]
    parts = [
        {"name": name, "relmse": float(row[k]), "share": float(row.sum() / total) if total > 0 else 0.0}
        for k, (name, row) in enumerate(zip(names, products, strict=True))
    ]
    return {"parts": parts, "total": total}


def noise_floor(error: np.ndarray, reference: np.ndarray) -> float:
    """relMSE below which a part or a whole cannot be told from standard errors (P, 3)."""
    return CLEAR * float((error**2 * weight(reference)).mean())
