"""The rules that are compared: how visibility and indirect light are found."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from benchmarks.visibility.settings import Settings
from mi_refgs.shade.accuracy import Accuracy


@dataclass(frozen=True)
class Rule:
    """How visibility and indirect light are found; 0 rays: not at all."""

    rays: int
    bounces: int = 0
    dominant: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        base = {0: "no occlusion", 1: "mirror ray"}.get(self.rays, f"{self.rays} rays")
        bounces = f", {self.bounces} bounce{'s' * (self.bounces > 1)}" if self.bounces else ""
        return base + bounces + ", dominant" * self.dominant

    def accuracy(self) -> Accuracy:
        """As the product is told."""
        return Accuracy(
            dominant=self.dominant, visibility_rays=max(self.rays, 1), traced_bounces=self.bounces
        )


PAPER = Rule(1)
"""One mirror ray for the whole lobe, and no traced light."""


def rules(settings: Settings) -> Iterator[Rule]:
    """All that are measured."""
    yield Rule(0)
    for rays in settings.counts:
        yield Rule(rays)
    for bounces in settings.bounces:
        for dominant in settings.dominant:
            for rays in (1, *settings.rays):
                yield Rule(rays, bounces, dominant)
        if settings.more_rays:
            yield Rule(max(settings.more_rays), bounces)
