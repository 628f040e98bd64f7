"""The background of photographs becomes the light that the loss `photographed` compares with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

from mi_refgs.data.view import evenly_spread
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.train import FEW_VIEWS, Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window


@register_event
@dataclass(frozen=True)
class PhotographLight(Event[Trainer]):
    """Renders the background from the object; of open scenes with a light only."""

    name: ClassVar[str] = "photograph_light"
    when: Window  # iterations at which it happens

    def due(self, trainer: Trainer) -> bool:
        open_ = trainer.fit.surroundings is not None and trainer.region is not None
        return open_ and trainer.method.light is not None and self.when.due(trainer.iteration)

    def apply(self, trainer: Trainer) -> None:
        trainer.check()
        light, around, region = trainer.fit.light, trainer.fit.surroundings, trainer.region
        assert light is not None and around is not None and region is not None
        views = trainer.data.views
        posed = [
            replace(views[i], to_world=trainer.camera(i).pose()) for i in evenly_spread(len(views), FEW_VIEWS)
        ]
        trainer.fit.photographed = PhotographedLight.of(
            trainer.surfels.detach(), around, region, posed, light.environment().height
        )
