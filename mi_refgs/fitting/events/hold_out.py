"""Validation views are held out of a fit until all decisions that they make are made."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mi_refgs.fitting.decide import hold_out, validates
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.event import Event, register


@register
@dataclass(frozen=True)
class HoldOut(Event[Trainer]):
    """Begins to hold them out, in a new or a resumed fit; the last decision ends it."""

    name: ClassVar[str] = "hold_out"
    always: ClassVar[bool] = True
    outside: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        return trainer.validation is None and validates(trainer)

    def apply(self, trainer: Trainer) -> None:
        hold_out(trainer)
