"""Parameters with a row per training view (`fitting.per_view`) begin to learn where the images need them.

Exposure gains are those that the photographs tell (`data.exposure.told_gains`), from the first step on, else
fitted to renders. What no image needs stays near 1: fitted gains within DEAD_ZONE of it count as 1, they
learn slowly, and the loss has a prior on them. Corrections of cameras begin at 0, and learn slowly, since
true cameras hardly move (`schedule.LEARNT_BESIDE`). Those of exact cameras would only blur the scene."""

import itertools
from dataclasses import dataclass, field
from functools import partial
from typing import ClassVar

import numpy as np

from mi_refgs.data.exposure import told_gains
from mi_refgs.data.view import evenly_spread
from mi_refgs.fitting.decide import Row, record, validates
from mi_refgs.fitting.image_error import aligned, with_gain
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import ITERATIONS, at_least
from mi_refgs.methods.method import GAIN, POSE

DEAD_ZONE = 0.05  # log gain that counts as none: that of a render in the first fifth of a fit
ALIGNED = 8  # training views whose cameras are compared with their images
EXACT = 0.5  # pixels that they move by, in the median, if they are exact: 0.1 to 0.4, after three tenths


@dataclass(frozen=True)
class PerView(Event[Trainer]):
    """An event that decides whether `parameter` learns."""

    parameter: ClassVar[str]
    # Iterations before they learn; absent: a fifth of all.
    after: int | None = field(default=None, metadata=ITERATIONS | at_least(0))

    def begins(self, iterations: int) -> int:
        """Iterations before they learn, of all."""
        return iterations // 5 if self.after is None else self.after

    def waits(self, trainer: Trainer) -> bool:
        """Whether it is too early to render what they are fitted to."""
        return trainer.iteration < self.begins(trainer.method.iterations)

    def due(self, trainer: Trainer) -> bool:
        waits = (0 < trainer.iteration and self.waits(trainer)) or validates(trainer)
        decided = any(row["component"] == self.name for row in trainer.fit.decisions)
        return not waits and not decided and self.parameter not in trainer.fit.params

    def apply(self, trainer: Trainer) -> None:
        if (found := self.first(trainer)) is not None:
            rows, needed, reason = found
            verdict = f"corrections of {self.name} {'stay' if needed else 'are left out'}"
            record(trainer, Row(self.name, trainer.iteration, needed, reason), verdict)
            if needed:
                trainer.fit.add(trainer.setup, self.parameter, upload_tensor(rows.astype(np.float32)))

    def first(self, trainer: Trainer) -> tuple[np.ndarray, bool, str] | None:
        """The initial values, a row per training view, whether any is needed, and why; None, before the
        first step, to wait for `after`."""
        raise NotImplementedError


@register_event
@dataclass(frozen=True)
class Cameras(PerView):
    """Lets the camera of each training view learn, a small rigid motion, unless they are exact."""

    name: ClassVar[str] = "cameras"
    parameter: ClassVar[str] = POSE

    def first(self, trainer: Trainer) -> tuple[np.ndarray, bool, str] | None:
        if self.waits(trainer):
            return None
        views = trainer.data.views
        moved = [_moved(trainer, i) for i in evenly_spread(len(views), ALIGNED)]
        off = float(np.median(moved))
        reason = f"{len(moved)} images fit {off:.2f} pixels from where their cameras say"
        return np.zeros((len(views), 6)), off > EXACT and len(views) > 1, reason


@register_event
@dataclass(frozen=True)
class Exposure(PerView):
    """Lets the exposure of each training view learn: a gain per channel on linear radiance."""

    name: ClassVar[str] = "exposure"
    parameter: ClassVar[str] = GAIN

    def first(self, trainer: Trainer) -> tuple[np.ndarray, bool, str] | None:
        data = trainer.data
        if (log := told_gains(data.views)) is None:
            if self.waits(trainer):
                return None
            views = [trainer.read(i) for i in range(len(data.views))]
            frames = (trainer.view(view.camera(), aovs=False) for view in views)
            fitted = [with_gain(frame, view, data)[0] for frame, view in zip(frames, views, strict=True)]
            log = np.log(fitted) - np.log(fitted).mean(axis=0)
            log = np.sign(log) * np.maximum(abs(log) - DEAD_ZONE, 0)
        least, most = np.exp([log.min(), log.max()])
        return log, bool(log.any()), f"gains of {least:.2f} to {most:.2f} per image"


def _moved(trainer: Trainer, index: int) -> float:
    """Pixels that what a view looks at moves by, if its pose is fitted to its image; the mean."""
    view, render = trainer.read(index), partial(trainer.view, aovs=False)
    everywhere = np.ones((view.height, view.width), bool)
    fitted = aligned(view, render(view.camera()), render, trainer.data, everywhere)
    points = trainer.setup.focus + trainer.setup.reach * np.array([*itertools.product((-0.5, 0.5), repeat=3)])
    before, after = (np.stack(one.project(points)[:2]) for one in (view, fitted))
    return float(np.linalg.norm(after - before, axis=0).mean()) * trainer.data.views[index].fx / view.fx
