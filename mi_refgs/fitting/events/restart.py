"""Restarts: attributes, and the light, begin anew where a stage begins. [Ref-Gaussian, implementation]"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.method import LIGHT
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.table import Surfels


@register_event
@dataclass(frozen=True)
class Restart(Event[Trainer]):
    """Gives what the next stage names (`stage.NAME.restart`) its initial values, without history."""

    name: ClassVar[str] = "restart"
    always: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        before, _ = trainer.method.stage_at(max(trainer.iteration, 1))
        name, stage = trainer.method.stage_at(trainer.iteration + 1)
        return bool(stage.restart) and name != before

    def apply(self, trainer: Trainer) -> None:
        fit, method, raw = trainer.fit, trainer.method, trainer.surfels.to_numpy()
        _, stage = method.stage_at(trainer.iteration + 1)
        rng = trainer.setup.rng(trainer.iteration + 1, "restart")
        names = tuple(name for name in stage.restart if name != LIGHT)
        for name in names:
            count, width = raw[name].shape
            raw[name] = attribute(name).start(count, width, rng, method.surfels.first(name))
        fit.tables[0].replace(Surfels.from_numpy(raw), cleared=names)
        if LIGHT in stage.restart and method.light is not None and method.light.learns:
            fit.params[LIGHT] = method.light.start()
            fit.optimiser.reset(LIGHT)
