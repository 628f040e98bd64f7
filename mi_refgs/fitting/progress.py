"""What a fit tells while it runs, to whoever listens."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mi_refgs.fitting.plan import Estimate
    from mi_refgs.fitting.train import Trainer


class Progress:
    """A listener that shows nothing; subclasses override what they show.

    `trainer` and `expected` stay afterwards: the state at the end, and the estimate of a new fit.
    """

    trainer: Trainer | None = None
    expected: Estimate | None = None

    def say(self, message: str) -> None:
        """What is going on, and what was decided."""

    def warn(self, message: str) -> None:
        """Something unusual about the data or the fit."""

    def begin(self, trainer: Trainer) -> None:
        """Ahead of the first step; also of a run that is finished already. Overrides call this one."""
        self.trainer = trainer

    def step(self, trainer: Trainer) -> None:
        """After each step: `trainer.iteration`, `.statistics()` (waits for the device), `.view(camera)`."""

    def end(self) -> None:
        """After the last step, and when the fit is interrupted or fails."""
