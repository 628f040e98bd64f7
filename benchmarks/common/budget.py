"""An error budget: from a shipped picture to the exact one, one approximation replaced at a time.

Any chain of pictures will do: the first is what ships, each next one has one more approximation replaced by
its exact counterpart, the last is the reference. The differences of neighbours add up to the whole error,
sign and all; their squares do not, and the rest is their interaction: twice the covariances.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.common.errors import weight


@dataclass(frozen=True)
class Step:
    """A picture (P, 3), and the approximation that it no longer makes ("" for the first)."""

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
        """Whether the squares alone explain the total to a fifth."""
        return abs(self.interaction) <= 0.2 * self.total

    def record(self) -> dict[str, Any]:
        """For JSON."""
        parts = [vars(part) for part in self.parts]
        return {
            "parts": parts,
            "total": self.total,
            "sum": self.sum,
            "interaction": self.interaction,
            "adds_up": self.adds_up,
            "pair": list(self.pair),
            "correlation": self.correlation,
        }


def take_apart(steps: Sequence[Step]) -> Budget:
    """Budget of a chain of at least two steps, the last of which is the reference."""
    reference = steps[-1].values
    root = np.sqrt(weight(reference))
    differences = [before.values - after.values for before, after in itertools.pairwise(steps)]
    scaled = np.stack([(difference * root).ravel() for difference in differences])
    products = scaled @ scaled.T / scaled.shape[1]
    total = float(products.sum())
    parts = tuple(
        Part(
            step.replaced,
            float(difference.mean() / reference.mean()),
            float(products[k, k]),
            float(products[k].sum() / total) if total > 0 else 0.0,
        )
        for k, (step, difference) in enumerate(zip(steps[1:], differences, strict=True))
    )
    cross = np.triu(products, 1)
    j, k = np.unravel_index(int(np.abs(cross).argmax()), cross.shape)
    size = float(np.sqrt(products[j, j] * products[k, k]))
    return Budget(
        parts,
        total,
        total - float(np.trace(products)),
        (parts[j].name, parts[k].name),
        float(cross[j, k]) / size if size > 0 else 0.0,
    )
