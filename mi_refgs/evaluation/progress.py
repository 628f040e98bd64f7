"""Previews of a fit in its run folder, and a bar in the terminal."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from mi_refgs.evaluation import images
from mi_refgs.fitting.progress import Progress
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import write_png
from mi_refgs.progress import progress_bar, say, warn

PSNR_MEMORY = 0.9
"""Share of the old value in the running PSNR of the bar: one view's is up to 5 dB off the mean."""


class Previews(Progress):
    """Writes previews/<iteration>.png into the run folder; warnings are Python's."""

    def warn(self, message: str) -> None:
        warnings.warn(message, stacklevel=2)

    def step(self, trainer: Trainer) -> None:
        """The first training view and the light, where a preview is due."""
        if trainer.run is None or trainer.iteration % trainer.method.preview_every:
            return
        view = trainer.data.views[0]
        shot = images.RenderedView.of(trainer.view(trainer.targets[0].camera), trainer.data, view)
        light = None
        if trainer.light is not None:
            radiance = trainer.light.radiance()
            light = images.light_panels(np.array(radiance, dtype=np.float32).reshape(radiance.shape))
        image = images.contact_sheet([images.panels(shot, view)], light)
        write_png(trainer.run.output.own(f"previews/{trainer.iteration:07d}.png"), image)


class Bar(Previews):
    """A progress bar and messages on standard error, besides the previews."""

    bar: Any = None
    psnr: float | None = None

    def say(self, message: str) -> None:
        say(message)

    def warn(self, message: str) -> None:
        warn(message)

    def begin(self, trainer: Trainer) -> None:
        super().begin(trainer)
        self.bar = progress_bar(
            trainer.method.iterations,
            trainer.method.variant,
            initial=trainer.iteration,
            smoothing=0.05,  # a short memory: the first steps compile kernels
        )

    def step(self, trainer: Trainer) -> None:
        if trainer.iteration % trainer.method.log_every == 0:
            # The numbers wait for the device, as the log of this iteration did already.
            numbers = trainer.statistics()
            new = float(numbers["psnr"])
            self.psnr = new if self.psnr is None else PSNR_MEMORY * self.psnr + (1 - PSNR_MEMORY) * new
            self.bar.set_postfix_str(
                f"loss {numbers['loss']:.4f}, PSNR {self.psnr:.1f} dB, {numbers['surfels']} surfels",
                refresh=False,
            )
        super().step(trainer)
        self.bar.update(trainer.iteration - self.bar.n)  # a trial is many iterations

    def end(self) -> None:
        self.bar.close()
