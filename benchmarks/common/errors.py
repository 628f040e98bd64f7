"""Errors of outgoing radiance against a reference with a standard error, and error budgets."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from benchmarks.common.montecarlo import Estimate
from benchmarks.common.report import Row, number, table

DARK = 0.01
"""Share of the mean radiance below which a relative error counts as one of this radiance."""
CLEAR = 2.0
"""A relMSE below this many times what the reference's own noise adds to it is not told from zero."""


def weight(reference: np.ndarray, scale: float | None = None) -> np.ndarray:
    """1 / (ref² + ε), the weight of squared errors; `scale` replaces the mean of `reference` in ε."""
    mean = float(reference.mean()) if scale is None else scale
    return 1 / (reference**2 + (DARK * mean) ** 2)


def compare(values: np.ndarray, reference: Estimate, where: np.ndarray | None = None) -> Row:
    """Errors of (P, 3) values, over all points or those of a mask (P,), each with the floor of the noise.

    bias: mean signed error over mean radiance; relmse: mean of (x - ref)² / (ref² + ε), ε = (0.01 mean)²;
    mape: mean of |x - ref| / (ref + 0.01 mean); below_floor: relMSE may be the reference's noise alone.
    """
    scale = float(reference.mean.mean())
    chosen = np.ones(len(values), bool) if where is None else where
    x, mean, noise = values[chosen], reference.mean[chosen], reference.error[chosen]
    w = weight(mean, scale)
    relmse, floor = float(((x - mean) ** 2 * w).mean()), float((noise**2 * w).mean())
    return {
        "bias": float((x - mean).mean() / mean.mean()),
        "relmse": relmse,
        "mape": float((np.abs(x - mean) / (mean + DARK * scale)).mean()),
        "bias_floor": float(np.sqrt((noise**2).sum()) / noise.size / mean.mean()),
        "relmse_floor": floor,
        "below_floor": relmse < CLEAR * floor,
    }


def mean_score(values: np.ndarray, reference: Estimate) -> float:
    """Mean error in its own standard errors, seen from the scatter over points (P, 3).

    Standard normal for an unbiased renderer, whatever it renders; the colours of a point count as one.
    """
    difference = ((values - reference.mean) * np.sqrt(weight(reference.mean))).sum(-1)
    return float(difference.sum() / np.sqrt((difference**2).sum()))


TOLERANCE = 0.2
"""Share of the total by which a sum of squares may miss it and still add up."""


class Step(NamedTuple):
    """An image (P, 3), and the approximation that it no longer makes ("" for the first)."""

    replaced: str
    values: np.ndarray


def decompose(steps: Sequence[Step]) -> Row:
    """Budget of a chain of at least two steps, the last of which is the reference.

    parts, in the order of the chain: bias (signed mean over mean radiance), relmse alone, and share of the
    total, the projection on the whole error e_k·e / e·e, negative where it cancels others. sum: of the
    parts' relmse; interaction: total - sum; pair: the two parts that interact most, and their correlation.
    """
    reference = steps[-1].values
    root = np.sqrt(weight(reference))
    differences = [before.values - after.values for before, after in itertools.pairwise(steps)]
    scaled = np.stack([(difference * root).ravel() for difference in differences])
    products = scaled @ scaled.T / scaled.shape[1]
    total, squares = float(products.sum()), float(np.trace(products))
    names = [step.replaced for step in steps[1:]]
    parts = [
        {
            "name": name,
            "bias": float(difference.mean() / reference.mean()),
            "relmse": float(row[k]),
            "share": float(row.sum() / total) if total > 0 else 0.0,
        }
        for k, (name, difference, row) in enumerate(zip(names, differences, products, strict=True))
    ]
    cross = np.triu(products, 1)
    j, k = np.unravel_index(int(np.abs(cross).argmax()), cross.shape)
    size = float(np.sqrt(products[j, j] * products[k, k]))
    return {
        "parts": parts,
        "total": total,
        "sum": squares,
        "interaction": total - squares,
        "adds_up": abs(total - squares) <= TOLERANCE * total,
        "pair": [names[j], names[k]],
        "correlation": float(cross[j, k]) / size if size > 0 else 0.0,
    }


def noise_floor(error: np.ndarray, reference: np.ndarray) -> float:
    """relMSE below which a part or a whole cannot be told from standard errors (P, 3)."""
    return CLEAR * float((error**2 * weight(reference)).mean())


# ---------------- as Markdown ----------------


def budget_table(head: str, cases: Iterable[tuple[str, Row]]) -> str:
    """A line for each labelled budget: parts, total, sum of squares and interaction."""
    found = list(cases)
    names = [part["name"] for part in found[0][1]["parts"]] if found else []
    rows = [[label, *_cells(case)] for label, case in found]
    return table([head, *names, "total", "sum", "interaction"], rows)


def _cells(case: Row) -> list[str]:
    if case["total"] < case["floor"]:
        return [*["–"] * len(case["parts"]), f"< {number(case['floor'], 2)}", "–", "noise"]
    parts = [f"{100 * part['share']:.0f} % ({number(part['relmse'], 2)})" for part in case["parts"]]
    left = f"{100 * case['interaction'] / case['total']:+.0f} %"
    if not case["adds_up"]:
        left += f": {case['pair'][0]} and {case['pair'][1]}, ρ = {case['correlation']:+.2f}"
    return [*parts, number(case["total"], 2), number(case["sum"], 2), left]


def interactions(budgets: Sequence[Row]) -> str:
    """The budgets above the noise whose squares do not add up, by the two parts that interact most."""
    pairs: dict[str, list[float]] = {}
    for row in above_noise(budgets):
        if not row["adds_up"]:
            pairs.setdefault(f"{row['pair'][0]} and {row['pair'][1]}", []).append(row["correlation"])
    rows = [
        [name, len(ρ), sum(x < 0 for x in ρ), f"{np.median(ρ):+.2f}"]
        for name, ρ in sorted(pairs.items(), key=lambda item: -len(item[1]))
    ]
    return table(["parts", "budgets", "cancel in", "median ρ"], rows)


def above_noise(budgets: Sequence[Row]) -> list[Row]:
    """The budgets whose total is no noise."""
    return [row for row in budgets if row["total"] >= row["floor"]]
