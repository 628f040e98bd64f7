"""Decides whether more surfels pay: twice as many are tried, then four times, where they improve images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

from mi_refgs.fitting.decide import Decision, Trial
from mi_refgs.fitting.events.densify import fill
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import register_event
from mi_refgs.methods.method import Method


@register_event
@dataclass(frozen=True)
class MoreSurfels(Decision):
    """Doubles the largest number of surfels as long as that pays."""

    name: ClassVar[str] = "more_surfels"
    gain: ClassVar[float] = 0.15  # a part of what twice as many gain in the end
    # In their order; children of a split improve the images after about 100 iterations.
    doubling: tuple[Trial, ...]

    def components(self) -> Sequence[str]:
        return [f"surfels_{2 ** (i + 1)}x" for i in range(len(self.doubling))]

    def chosen(self, method: Method, component: str) -> Method:
        capacity = 2.0 ** (1 + self.components().index(component))
        return replace(method, surfels=replace(method.surfels, capacity=capacity))

    def trial_of(self, component: str) -> Trial:
        return self.doubling[self.components().index(component)]

    def begin(self, rival: Trainer) -> str:
        before = rival.surfels.count
        fill(rival)
        return "" if rival.surfels.count > before else "no surfels to split: densification has ended"

    def pending(self, decisions: Sequence[Mapping[str, Any]]) -> list[str]:
        """Those after a doubling that did not pay are decided, too."""
        mine = [row for row in decisions if row["component"] in self.components()]
        return super().pending(decisions) if all(row["stays"] for row in mine) else []
