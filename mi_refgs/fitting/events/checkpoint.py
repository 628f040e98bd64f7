"""Checkpoints, from which a killed fit is resumed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.event import Event, register


@dataclass(frozen=True)
class Checkpoint(Event[Trainer]):
    """Saves the fit every `checkpoint_every` iterations of the method."""

    name: ClassVar[str] = "checkpoint"
    always: ClassVar[bool] = True
    outside: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        return trainer.iteration % trainer.method.checkpoint_every == 0 and trainer.iteration != trainer.saved

    def apply(self, trainer: Trainer) -> None:
        trainer.save()


register(Checkpoint)
