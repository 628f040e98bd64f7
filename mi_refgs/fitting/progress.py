"""Interface of listeners to a fit: progress bar, previews, live viewer."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mi_refgs.fitting.plan import Estimate
    from mi_refgs.fitting.train import Trainer


class Progress:
    """A listener that displays nothing; subclasses override methods."""

    trainer: Trainer | None = None  # of the fit, also after its end
    expected: Estimate | None = None  # of a new fit

    def say(self, message: str) -> None:
        """Is called with messages about the fit and its decisions."""

    def warn(self, message: str) -> None:
        """Is called with warnings about the data or the fit."""

    def begin(self, trainer: Trainer) -> None:
        """Is called before the first step, also of a finished run. Overrides call this one."""
        self.trainer = trainer

    def step(self, trainer: Trainer) -> None:
        """Is called after each step. `trainer.statistics()` waits for the device, `.view(camera)` renders."""

    def end(self) -> None:
        """Is called after the last step, and when the fit is interrupted or fails."""
