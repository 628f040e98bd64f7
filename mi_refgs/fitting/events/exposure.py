"""Per-image exposure compensation: exposure and white balance that differ between photographs.

The gains start from EXIF data if every image has them, are fitted to renders at `after`, and learn from then
on. What no image needs stays near 1: fitted gains within DEAD_ZONE of it count as 1, they learn slowly
(`schedule.GAIN_RATE`), and the loss has a prior on them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import MAX_GAIN
from mi_refgs.fitting.decide import validates
from mi_refgs.fitting.image_error import with_gain
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.event import Event, register
from mi_refgs.methods.method import GAIN
from mi_refgs.methods.ranges import at_least
from mi_refgs.methods.window import ITERATIONS

EXIF_SPREAD = 0.02  # standard deviation of log exposures below which EXIF exposures count as equal
DEAD_ZONE = 0.05
"""Log gain that counts as none: that of a render in the first fifth of a fit to images of one exposure."""
EXPOSURE_FILE = "exposure.json"  # of a run: the gains by view


@dataclass(frozen=True)
class Exposure(Event[Trainer]):
    """Lets the exposure of each training view learn: a gain per channel on linear radiance."""

    name: ClassVar[str] = "exposure"

    after: int = field(default=1_200, metadata=ITERATIONS | at_least(0))  # iterations before gains learn

    def due(self, trainer: Trainer) -> bool:
        if validates(trainer):  # the views of the fit change with the decision
            return False
        learns = trainer.fit.optimiser.factors.get(GAIN, 0.0) > 0
        return not learns and (trainer.iteration in (0, self.after) or trainer.iteration > self.after)

    def apply(self, trainer: Trainer) -> None:
        fit, data = trainer.fit, trainer.data
        if trainer.iteration < self.after:
            if (log := exif_gains(data)) is not None:
                fit.add(trainer.setup, GAIN, upload_tensor(log))
                fit.optimiser.set_factor(GAIN, 0.0)
            return
        frames = (trainer.view(trainer.camera(i), aovs=False) for i in range(len(data.views)))
        fitted = [with_gain(frame, view, data)[0] for frame, view in zip(frames, data.views, strict=True)]
        log = np.log(fitted) - np.log(fitted).mean(axis=0)
        log = np.sign(log) * np.maximum(abs(log) - DEAD_ZONE, 0)
        fit.add(trainer.setup, GAIN, upload_tensor(log.astype(np.float32)))
        fit.optimiser.set_factor(GAIN, 1.0)
        least, most = np.exp([log.min(), log.max()])
        trainer.tell(f"exposure: gains of {least:.2f} to {most:.2f} per image")


def exif_gains(data: Dataset) -> np.ndarray | None:
    """Log gains (V, 3) from EXIF data, 0 for the median, within the limits of `fitted_gain`.

    None if a view has no such data, or all have the same.
    """
    log = [view.exposure for view in data.views]
    if any(value is None for value in log):
        return None
    values, limit = np.array(log, dtype=np.float64), np.log(MAX_GAIN)
    if values.std() < EXIF_SPREAD:
        return None
    gains = np.clip(values - np.median(values), -limit, limit)
    return np.repeat(gains[:, None], 3, axis=1).astype(np.float32)


register(Exposure)
