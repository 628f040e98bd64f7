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

from benchmarks.common.errors import CLEAR, weight
from benchmarks.common.view import view_bins

TOLERANCE = 0.2
"""Share of the total by which a sum of squares may miss it and still add up."""


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
class Place:
    """A range of n·v: its share of the points, and of the covariance of the two parts that interact most."""

    name: str
    points: float
    share: float


@dataclass(frozen=True)
class Budget:
    """Parts in the order of the chain; `interaction` = total - sum of the parts' relMSE."""

    parts: tuple[Part, ...]
    total: float
    interaction: float
    pair: tuple[str, str]  # the two parts that interact most
    correlation: float  # of these two
    covariance: float  # twice theirs: what of the interaction they explain
    where: tuple[Place, ...]  # it comes from
    joined: tuple[float, ...]  # sum of squares with the first groups of parts, 1, 2, …, as one part each

    @property
    def sum(self) -> float:
        """Sum of the parts' relMSE."""
        return self.total - self.interaction

    def adds_up(self, squares: float) -> bool:
        """Whether a sum of squares alone explains the total."""
        return abs(self.total - squares) <= TOLERANCE * self.total

    def record(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "parts": [vars(part) for part in self.parts],
            "total": self.total,
            "sum": self.sum,
            "interaction": self.interaction,
            "adds_up": self.adds_up(self.sum),
            "pair": list(self.pair),
            "correlation": self.correlation,
            "pair_explains": self.adds_up(self.sum + self.covariance),
            "where": [vars(place) for place in self.where],
            "joined_add_up": [self.adds_up(squares) for squares in self.joined],
        }


def take_apart(steps: Sequence[Step], n_dot_v: np.ndarray, groups: Sequence[tuple[str, str]] = ()) -> Budget:
    """Budget of a chain of at least two steps, the last of which is the reference.

    Args:
        n_dot_v: cosine of the view angle (P,), to tell where parts interact.
        groups: pairs of parts that may be looked at as one; those without such parts change nothing.
    """
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
    both = (scaled[j] * scaled[k]).reshape(reference.shape).sum(-1)
    bins = view_bins(n_dot_v).items() if both.sum() != 0 else ()
    squares, joined = float(np.trace(products)), []
    for group in groups:
        if set(group) <= set(names):
            first, second = (names.index(name) for name in group)
            squares += 2 * float(products[first, second])
        joined.append(squares)
    return Budget(
        parts,
        total,
        total - float(np.trace(products)),
        (names[j], names[k]),
        float(cross[j, k]) / size if size > 0 else 0.0,
        2 * float(cross[j, k]),
        tuple(Place(name, float(mask.mean()), float(both[mask].sum() / both.sum())) for name, mask in bins),
        tuple(joined),
    )


def noise_floor(error: np.ndarray, reference: np.ndarray) -> float:
    """relMSE below which a part or a whole cannot be told from standard errors (P, 3)."""
    return CLEAR * float((error**2 * weight(reference)).mean())
