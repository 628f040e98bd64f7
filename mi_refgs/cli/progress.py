"""What `refgs train` shows of a fit while it runs: a bar in the terminal, previews in the run folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mi_refgs.cli.command import warn
from mi_refgs.progress_bar import progress_bar

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.runs.run import Run

PSNR_MEMORY = 0.9
"""Share of the old value in the running PSNR of the bar: one view's is up to 5 dB off the mean."""


class Progress:
    """The progress bar on standard error, and the previews; called by the trainer after each step."""

    def __init__(self, trainer: Trainer, folder: Run) -> None:
        self.folder = folder
        self.psnr: float | None = None
        self.bar = progress_bar(
            trainer.method.iterations,
            trainer.method.variant,
            initial=trainer.iteration,
            smoothing=0.05,  # a short memory: the first steps compile kernels
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
