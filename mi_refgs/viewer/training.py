"""The page of a running fit: images between steps, curves of its loss and PSNR. Images are rendered only
while a page is open, and then take at most SHARE of the time."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_refgs.reconstruction.fit import ProgressBar
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.run import LOG, Run, read_log
from mi_refgs.splat.camera import Camera
from mi_refgs.viewer.page import Page, require_free, require_viser
from mi_refgs.viewer.panels import add_cameras, add_display
from mi_refgs.viewer.reconstruction_view import bounds_of, variables_of
from mi_refgs.viewer.viewer_scene import IMAGE, DisplayOptions, ViewerScene, backdrops_of

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer

SHARE = 0.25  # part of the time that images may take while a page is open
REFRESH = 2.0  # seconds between displays of the present state of the fit
LARGEST = 400  # finest resolution level: a usual fit has smaller images
CURVES = {"loss": "#4dabf7", "psnr": "#ffa94d"}
"""Numbers of the log that are plotted, and their colours."""


class Training(ViewerScene):
    """The present state of a fit as a viewer scene."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.centre, self.radius = bounds_of(trainer.surfels, trainer.region)
        names = variables_of(trainer.surfels, trainer.shading())
        self.variables = tuple(name for name in names if name != "visibility")  # in all stages
        self.backdrops = backdrops_of(trainer.fit.surroundings is not None, light=False)

    def frame(self, camera: Camera, look: DisplayOptions, settled: bool) -> Frame:
        """See `ViewerScene`."""
        return self.trainer.view(camera, look.what != IMAGE, look.object_only)


class TrainingViewer(ProgressBar):
    """The progress bar of a fit, and its page."""

    def __init__(self, host: str, port: int) -> None:
        """Raises InputError if the port is taken."""
        require_viser()
        require_free(host, port)
        self.address = host, port
        self.page: TrainingPage | None = None

    def begin(self, trainer: Trainer) -> None:
        super().begin(trainer)
        if trainer.run is not None:
            self.page = TrainingPage(trainer, trainer.run, self.address)
            self.say(f"open {self.page.url} in a browser to watch")

    def step(self, trainer: Trainer) -> None:
        super().step(trainer)
        if self.page is not None:
            self.page.step()

    def end(self) -> None:
        super().end()
        if self.page is not None:
            self.page.close()


class TrainingPage(Page):
    """The page of a running fit; `step` is called after each of its steps."""

    def __init__(
        self,
        trainer: Trainer,
        run: Run,
        address: tuple[str, int],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Serve the page."""
        from viser import uplot

        data = {"train": trainer.data}
        super().__init__(Training(trainer), data, run.path.resolve().name, address, run.path / "views")
        self.loop.display(largest=LARGEST)
        self.loop.smooth, self.loop.clock = False, clock
        self.log, self.clock = run.path / LOG, clock
        self.since, self.spent, self.refreshed = clock(), 0.0, -REFRESH
        add_display(self)
        self.curves, empty, iteration = dict[str, Any](), np.zeros(1), uplot.Series(label="iteration")
        scales = {"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)}
        with self.server.gui.add_folder("Training"):
            for name, colour in CURVES.items():
                series = (iteration, uplot.Series(label=name, stroke=colour, width=2))
                plot = self.server.gui.add_uplot(
                    (empty, empty), series, scales=scales, title=name, aspect=2.0
                )
                self.curves[name] = plot
        add_cameras(self)
        self.listen()

    def step(self) -> None:
        """Draw what open pages wait for, within the share of time."""
        now = self.clock()
        if not self.loop.clients:
            self.since, self.spent = now, 0.0
            return
        if now - self.refreshed > REFRESH:
            self.refreshed = now
            lines = read_log(self.log, ("iteration", *CURVES))
            for name, plot in self.curves.items() if len(lines) > 1 else ():
                plot.data = tuple(np.array([line[key] for line in lines]) for key in ("iteration", name))
            self.loop.change()
        if self.spent <= SHARE * (now - self.since):
            self.loop.step()
            self.spent += self.clock() - now
