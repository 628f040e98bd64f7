"""Per-image exposure compensation: exposure and white balance that differ between photographs.

The gains are fitted to renders at `after`, and learn from then on. What no image needs stays near 1: fitted
gains within DEAD_ZONE of it count as 1, they learn slowly, and the loss has a prior on them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mi_refgs.fitting.decide import per_view_begins
from mi_refgs.fitting.image_error import with_gain
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.event import Event, register
from mi_refgs.methods.method import GAIN
from mi_refgs.methods.ranges import at_least
from mi_refgs.methods.window import ITERATIONS

DEAD_ZONE = 0.05  # log gain that counts as none: that of a render in the first fifth of a fit
EXPOSURE_FILE = "exposure.json"  # of a run: the gains by view


@register
@dataclass(frozen=True)
class Exposure(Event[Trainer]):
    """Lets the exposure of each training view learn: a gain per channel on linear radiance."""

    name: ClassVar[str] = "exposure"
    after: int = field(default=1_200, metadata=ITERATIONS | at_least(0))  # iterations before gains learn

    def due(self, trainer: Trainer) -> bool:
        return per_view_begins(trainer, self.after, GAIN)

    def apply(self, trainer: Trainer) -> None:
        fit, data = trainer.fit, trainer.data
        frames = (trainer.view(trainer.camera(i), aovs=False) for i in range(len(data.views)))
        fitted = [with_gain(frame, view, data)[0] for frame, view in zip(frames, data.views, strict=True)]
        log = np.log(fitted) - np.log(fitted).mean(axis=0)
        log = np.sign(log) * np.maximum(abs(log) - DEAD_ZONE, 0)
        fit.add(trainer.setup, GAIN, upload_tensor(log.astype(np.float32)))
        least, most = np.exp([log.min(), log.max()])
        trainer.tell(f"exposure: gains of {least:.2f} to {most:.2f} per image")
