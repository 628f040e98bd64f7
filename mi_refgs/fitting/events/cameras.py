"""Corrections of inaccurate cameras: from `after` on, a small rigid motion of each learns (`per_view`).

True cameras hardly move: the corrections start at 0, and learn slowly (`schedule.LEARNT_BESIDE`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mi_refgs.fitting.decide import per_view_begins
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.event import Event, register
from mi_refgs.methods.method import POSE
from mi_refgs.methods.ranges import at_least
from mi_refgs.methods.window import ITERATIONS


@register
@dataclass(frozen=True)
class Cameras(Event[Trainer]):
    """Lets the camera of each training view learn."""

    name: ClassVar[str] = "cameras"
    after: int = field(default=1_200, metadata=ITERATIONS | at_least(0))  # iterations before cameras learn

    def due(self, trainer: Trainer) -> bool:
        return per_view_begins(trainer, self.after, POSE)

    def apply(self, trainer: Trainer) -> None:
        rows = np.zeros((len(trainer.data.views), 6), np.float32)
        trainer.fit.add(trainer.setup, POSE, upload_tensor(rows))
