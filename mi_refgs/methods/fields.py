"""What the fields of settings say of themselves, `field(default=0.25, metadata=at_least(0))`, and windows."""

import math
from dataclasses import dataclass
from typing import Any

Metadata = dict[str, Any]
"""Of a field. "allowed": a test of values that are not None, and a text that completes "give …"."""
ITERATIONS: Metadata = {"unit": "iterations"}  # of a field that counts iterations, which a preset scales
FLAT: Metadata = {"flat": True}  # of a dataclass's field that is one too, with keys in the same table
TIE = 1e-6  # intervals by which a scaled window may miss a multiple of its interval through rounding


def at_least(low: float) -> Metadata:
    """Metadata of a finite number that is at least `low`."""
    return {"allowed": (lambda value: low <= value < math.inf, f"{low:,} or more")}


def between(low: float, high: float) -> Metadata:
    """Metadata of a number from `low` to `high`, both included."""
    return {"allowed": (lambda value: low <= value <= high, f"a number from {low:g} to {high:g}")}


@dataclass(frozen=True)
class Window:
    """Events at the multiples of `every` with start < multiple ≤ until, once at each nearest iteration; not
    whole numbers: presets scale them."""

    start: float
    until: float
    every: float

    def __post_init__(self) -> None:
        """Raise ValueError for an interval that is not positive, and for infinities and NaN."""
        if not self.every > 0 or not math.isfinite(self.start + self.until + self.every):
            raise ValueError("expected finite numbers and an 'every' above 0; correct the window")

    def due(self, iteration: int) -> bool:
        """Whether an event falls on this (1-based) iteration."""
        return self.count(iteration) > self.count(iteration - 1)

    def count(self, iteration: int) -> int:
        """Events up to and including this iteration."""
        return max(self._newest(iteration) - math.floor(self.start / self.every + TIE), 0)

    def since(self, iteration: int) -> int | None:
        """Iterations since the last event before this one; None if there was none yet."""
        newest = math.floor(self._newest(iteration - 1) * self.every + 0.5)
        return iteration - newest if self.count(iteration - 1) else None

    def _newest(self, iteration: int) -> int:
        """The largest k ≤ until / every for which k · every rounds to this iteration or one before."""
        return min(math.ceil((iteration + 0.5) / self.every) - 1, math.floor(self.until / self.every + TIE))
