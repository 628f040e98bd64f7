"""Parameters with a row per training view (`fitting.per_view`) begin to learn, once the views are final.

Exposure gains are those that the photographs tell (`data.exposure.told_gains`), from the first step on, else
fitted to renders. What no image needs stays near 1: fitted gains within DEAD_ZONE of it count as 1, they
learn slowly, and the loss has a prior on them. Corrections of cameras begin at 0, and
learn slowly, since true cameras hardly move (`schedule.LEARNT_BESIDE`)."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mi_refgs.data.exposure import told_gains
from mi_refgs.fitting.decide import validates
from mi_refgs.fitting.image_error import with_gain
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import ITERATIONS, at_least
from mi_refgs.methods.method import GAIN, POSE

DEAD_ZONE = 0.05  # log gain that counts as none: that of a render in the first fifth of a fit


@dataclass(frozen=True)
class PerView(Event[Trainer]):
    """An event after which `parameter` learns."""

    parameter: ClassVar[str]
    after: int = field(default=1_200, metadata=ITERATIONS | at_least(0))  # iterations before they learn

    def due(self, trainer: Trainer) -> bool:
        waits = 0 < trainer.iteration < self.after or validates(trainer)
        return not waits and self.parameter not in trainer.fit.params

    def apply(self, trainer: Trainer) -> None:
        if (rows := self.first(trainer)) is not None:
            trainer.fit.add(trainer.setup, self.parameter, upload_tensor(rows.astype(np.float32)))

    def first(self, trainer: Trainer) -> np.ndarray | None:
        """The initial values, a row per training view; None, before the first step, to wait for `after`."""
        raise NotImplementedError


@register_event
@dataclass(frozen=True)
class Cameras(PerView):
    """Lets the camera of each training view learn: a small rigid motion."""

    name: ClassVar[str] = "cameras"
    parameter: ClassVar[str] = POSE

    def first(self, trainer: Trainer) -> np.ndarray | None:
        return np.zeros((len(trainer.data.views), 6)) if trainer.iteration >= self.after else None


@register_event
@dataclass(frozen=True)
class Exposure(PerView):
    """Lets the exposure of each training view learn: a gain per channel on linear radiance."""

    name: ClassVar[str] = "exposure"
    parameter: ClassVar[str] = GAIN

    def first(self, trainer: Trainer) -> np.ndarray | None:
        data = trainer.data
        if (log := told_gains(data.views)) is None:
            if trainer.iteration < self.after:
                return None
            frames = (trainer.view(trainer.camera(i), aovs=False) for i in range(len(data.views)))
            fitted = [with_gain(frame, view, data)[0] for frame, view in zip(frames, data.views, strict=True)]
            log = np.log(fitted) - np.log(fitted).mean(axis=0)
            log = np.sign(log) * np.maximum(abs(log) - DEAD_ZONE, 0)
        least, most = np.exp([log.min(), log.max()])
        trainer.tell(f"exposure: gains of {least:.2f} to {most:.2f} per image")
        return log
