"""What `refgs train` shows of a fit while it runs: a bar in the terminal, previews in the run folder."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING

from mi_refgs.cli.command import warn

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.runs.run import Run

PSNR_MEMORY = 0.9
"""Share of the old value in the running PSNR of the bar: one view's is up to 5 dB off the mean."""
TERMINAL_INTERVAL, LOG_INTERVAL = 0.5, 30.0
"""Seconds between refreshes of the progress bar, in a terminal and in a file."""


class Progress:
    """The progress bar on standard error, and the previews; called by the trainer after each step."""

    def __init__(self, trainer: Trainer, folder: Run) -> None:
        from tqdm import tqdm

        self.folder = folder
        self.psnr: float | None = None
        self.bar = tqdm(
            total=trainer.method.iterations,
            initial=trainer.iteration,
            desc=trainer.method.variant,
            unit="it",
            file=sys.stderr,
            dynamic_ncols=True,
            smoothing=0.05,  # a short memory: the first steps compile kernels
            mininterval=TERMINAL_INTERVAL if sys.stderr.isatty() else LOG_INTERVAL,
        )

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.bar.close()

    def __call__(self, trainer: Trainer) -> None:
        method = trainer.method
        while trainer.notices:
            warn(trainer.notices.pop(0))
        if trainer.iteration % method.log_every == 0:
            # The numbers wait for the device, as the log of this iteration did already.
            numbers = trainer.statistics()
            new = float(numbers["psnr"])
            self.psnr = new if self.psnr is None else PSNR_MEMORY * self.psnr + (1 - PSNR_MEMORY) * new
            self.bar.set_postfix_str(
                f"loss {numbers['loss']:.4f}, PSNR {self.psnr:.1f} dB, {numbers['surfels']} surfels",
                refresh=False,
            )
        if trainer.iteration % method.preview_every == 0:
            self._preview(trainer)
        self.bar.update(trainer.iteration - self.bar.n)  # a trial is many iterations

    def _preview(self, trainer: Trainer) -> None:
        """The first training view and the light, as previews/<iteration>.png."""
        import numpy as np

        from mi_refgs.evaluation import pictures
        from mi_refgs.images import write_png

        view = trainer.data.views[0]
        shot = pictures.RenderedView.of(trainer.view(trainer.targets[0].camera), trainer.data, view)
        light = None
        if trainer.light is not None:
            radiance = trainer.light.radiance()
            light = pictures.lights(np.array(radiance, dtype=np.float32).reshape(radiance.shape))
        image = pictures.sheet([pictures.panels(shot, view)], light)
        write_png(self.folder.path / "previews" / f"{trainer.iteration:07d}.png", image)
