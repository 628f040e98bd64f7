"""Errors of outgoing radiance against a reference with a standard error, and error budgets."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.common.montecarlo import Estimate
from benchmarks.common.report import number, table
from mi_refgs.evaluation import metrics
from mi_refgs.io.images import srgb_from_linear

DARK = 0.01
"""Share of the mean radiance below which a relative error counts as one of this radiance."""
CLEAR = 2.0
"""A relMSE below this many times what the reference's own noise adds to it is not told from zero."""


@dataclass(frozen=True)
class Errors:
    """Errors of one image, each with the floor that the reference's noise sets.

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


def flip(image: np.ndarray, truth: np.ndarray) -> tuple[float | None, str]:
    """(Mean LDR FLIP, "") of linear images, exposed so that the true mean is ½; or (None, why)."""
    lit = truth[truth > 0]
    exposure = 0.5 / float(lit.mean())
    return metrics.flip(srgb_from_linear(image * exposure), srgb_from_linear(truth * exposure))


def mean_score(values: np.ndarray, reference: Estimate) -> float:
    """Mean error in its own standard errors, seen from the scatter over points (P, 3).

    Standard normal for an unbiased renderer, whatever it renders; the colours of a point count as one.
    """
    difference = ((values - reference.mean) * np.sqrt(weight(reference.mean))).sum(-1)
    return float(difference.sum() / np.sqrt((difference**2).sum()))


TOLERANCE = 0.2
"""Share of the total by which a sum of squares may miss it and still add up."""
Row = dict[str, Any]


@dataclass(frozen=True)
class Step:
    """An image (P, 3), and the approximation that it no longer makes ("" for the first)."""

    replaced: str
    values: np.ndarray


@dataclass(frozen=True)
class Part:
    """What one approximation adds: signed mean over mean radiance, relMSE on its own, share of the total.

    Shares are projections on the whole error, e_k·e / e·e: they add up to 1; a negative one cancels others.
    """

    name: str
    bias: float
    relmse: float
    share: float


@dataclass(frozen=True)
class Budget:
    """Parts in the order of the chain; `interaction` = total - sum of the parts' relMSE."""

    parts: tuple[Part, ...]
    total: float
    interaction: float
    pair: tuple[str, str]  # the two parts that interact most
    correlation: float  # of these two

    @property
    def sum(self) -> float:
        """Sum of the parts' relMSE."""
        return self.total - self.interaction

    @property
    def adds_up(self) -> bool:
        """Whether the sum of squares alone explains the total."""
        return abs(self.interaction) <= TOLERANCE * self.total

    def record(self) -> Row:
        """For JSON."""
        parts = {"parts": [vars(part) for part in self.parts], "sum": self.sum, "adds_up": self.adds_up}
        return vars(self) | parts | {"pair": list(self.pair)}


def decompose(steps: Sequence[Step]) -> Budget:
    """Budget of a chain of at least two steps, the last of which is the reference."""
    reference = steps[-1].values
    root = np.sqrt(weight(reference))
    differences = [before.values - after.values for before, after in itertools.pairwise(steps)]
    scaled = np.stack([(difference * root).ravel() for difference in differences])
    products = scaled @ scaled.T / scaled.shape[1]
    total = float(products.sum())
    names = [step.replaced for step in steps[1:]]
    parts = tuple(
        Part(
            name,
            float(difference.mean() / reference.mean()),
            float(products[k, k]),
            float(products[k].sum() / total) if total > 0 else 0.0,
        )
        for k, (name, difference) in enumerate(zip(names, differences, strict=True))
    )
    cross = np.triu(products, 1)
    j, k = (int(x) for x in np.unravel_index(int(np.abs(cross).argmax()), cross.shape))
    size = float(np.sqrt(products[j, j] * products[k, k]))
    correlation = float(cross[j, k]) / size if size > 0 else 0.0
    return Budget(parts, total, total - float(np.trace(products)), (names[j], names[k]), correlation)


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
