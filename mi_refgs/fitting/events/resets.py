"""Resets: opacities that surfels grow back if images require them, and what a stage begins anew."""

import math
from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window
from mi_refgs.methods.method import LIGHT
from mi_refgs.surfels.attributes import ATTRIBUTES, attribute, logit
from mi_refgs.surfels.table import Surfels

OPACITY = 0.01  # of all surfels after a reset, at most
PATIENCE = 4.5  # factor of the fewest steps in which an opacity can grow back; with 2, a scene was lost


@register_event
@dataclass(frozen=True)
class ResetOpacity(Event[Trainer]):
    """Lowers the opacities of the object; the background map would replace the background's surfels, blurred.
    [3DGS §5.2] Attributes in `raise_to_start` rise to at least their initial value. [3DGS-DR: metallic]"""

    name: ClassVar[str] = "reset_opacity"
    when: Window  # iterations at which it happens
    raise_to_start: tuple[str, ...] = ()  # bounded attributes

    def require(self, attributes: Collection[str]) -> None:
        for name in self.raise_to_start:
            if name not in attributes or ATTRIBUTES[name].activation != "sigmoid":
                what = f"'{name}' is no attribute between 0 and 1"
                raise InputError(what, "raise_to_start", remedy="remove it")

    def due(self, trainer: Trainer) -> bool:
        return self.when.due(trainer.iteration)

    def apply(self, trainer: Trainer) -> None:
        raw = trainer.surfels.to_numpy()
        raw["opacity"] = np.minimum(raw["opacity"], np.float32(logit(OPACITY)))
        for name in self.raise_to_start:
            raw[name] = np.maximum(raw[name], np.float32(logit(trainer.method.surfels.first(name))))
        trainer.fit.tables[0].replace(Surfels.from_numpy(raw), cleared=("opacity", *self.raise_to_start))

    def grown(self, iteration: int, opacity: float, rate: float) -> bool:
        """Whether opacities had time since the last reset to grow back: Adam raises a logit by its rate."""
        if (since := self.when.since(iteration)) is None:
            return True
        lift = max(logit(opacity) - logit(OPACITY), 0.0)
        return since >= (PATIENCE * lift / rate if rate > 0 else math.inf)


@register_event
@dataclass(frozen=True)
class Restart(Event[Trainer]):
    """Gives what the next stage names (`stage.NAME.restart`) its initial values, without history."""

    name: ClassVar[str] = "restart"
    always: ClassVar[bool] = True

    def due(self, trainer: Trainer) -> bool:
        method, after = trainer.method, trainer.iteration
        before, (name, stage) = method.stage_at(max(after, 1))[0], method.stage_at(after + 1)
        return bool(stage.restart) and name != before and after < method.iterations

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
