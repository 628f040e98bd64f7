"""The learning rate of a tensor over the iterations of a fit."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Group:
    """Learning rate of one tensor: from `rate` log-linearly to `final` in `steps` iterations, then constant.

    The first `head` columns learn at the rate, the others at rate · tail (spherical harmonics: head 3, tail
    1/20).
    """

    rate: float  # per step, units of the raw tensor
    final: float | None = None  # None: constant
    steps: int = 1  # iterations
    head: int = 0  # columns; 0: every column
    tail: float = 1.0  # factor
    relative: bool = False  # what is above 1 learns at the rate times itself: a lamp grows by shares
    unit: float = 1.0  # of the raw tensor, to which the moments refer: ε, and what float32 squares, have none

    def at(self, iteration: int) -> float:
        """Learning rate at this iteration (0-based)."""
        if self.final is None or self.rate <= 0 or self.final <= 0:
            return self.rate
        progress = min(max(iteration / max(self.steps, 1), 0.0), 1.0)
        return math.exp((1 - progress) * math.log(self.rate) + progress * math.log(self.final))
