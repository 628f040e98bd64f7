"""A fit as a page shows it while it runs: pictures between steps, curves of its loss and PSNR.

A fit pays for it only while somebody looks, and then at most SHARE of its time.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np

from mi_refgs.reconstruction.fit import ProgressBar
from mi_refgs.runs.run import LOG, Run
from mi_refgs.viewer.controls import look, overlays
from mi_refgs.viewer.page import Page, Views, require_free, require_viser
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import bounds_of, variables_of
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, backdrops_of, planes_of
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, fine_planes

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer

SHARE = 0.25
"""Part of the time that pictures may take while somebody looks."""
REFRESH = 2.0
"""Seconds after which a picture and the curves show the present state of the fit."""
LARGEST = 400
"""Rung of the pictures, at most: a fit of everyday size has smaller ones."""
CURVES = {"loss": "#4dabf7", "psnr": "#ffa94d"}
"""Numbers of the log that are plotted, and their colours."""


class Training:
    """A trainer as something to draw."""

    square_pixels = False

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.centre, self.radius = bounds_of(trainer.surfels, trainer.data.region)

    @property
    def variables(self) -> tuple[str, ...]:
        """See `ViewerScene`; those that the fit has from its first stage on."""
        shading = self.trainer.shading()
        return tuple(name for name in variables_of(self.trainer.surfels, shading) if name != "visibility")

    @property
    def backdrops(self) -> tuple[str, ...]:
        """See `ViewerScene`."""
        return backdrops_of(self.trainer.surroundings is not None, light=False)

    def draw(self, sample: SampleRequest) -> SampleResult:
        """See `ViewerScene`."""
        camera = sample.camera()
        frame = self.trainer.view(camera, sample.look.what != IMAGE, sample.look.object_only)
        with dr.suspend_grad():
            return SampleResult(planes_of(frame, camera, sample.look, None), frame.depth)

    def fine(self, pose: Pose, width: int, height: int, look: DisplayOptions) -> list[Any]:
        """See `ViewerScene`."""
        trainer = self.trainer
        return fine_planes(self.draw, pose, width, height, look, trainer.shading(), trainer.surfels.count)


class TrainingViewer(ProgressBar):
    """The progress bar of a fit, and its page."""

    def __init__(self, host: str, port: int) -> None:
        """Raises InputError if the port is taken, and without viser."""
        require_viser()
        require_free(host, port)
        self.host, self.port = host, port
        self.page: TrainingPage | None = None

    def begin(self, trainer: Trainer) -> None:
        super().begin(trainer)
        if trainer.run is not None:
            self.page = TrainingPage(trainer, trainer.run, self.host, self.port)
            self.say(f"open {self.page.page.url} in a browser to watch")

    def step(self, trainer: Trainer) -> None:
        super().step(trainer)
        if self.page is not None:
            self.page.step()

    def end(self) -> None:
        super().end()
        if self.page is not None:
            self.page.page.close()


class TrainingPage:
    """The page of a running fit; `step` is called after each of its steps."""

    def __init__(
        self,
        trainer: Trainer,
        run: Run,
        host: str,
        port: int,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Serve the page; raises InputError if the port is taken, and without viser."""
        self.page = Page(
            Training(trainer),
            Views(train=trainer.data),
            run.path.resolve().name,
            host,
            port,
            run.path / "views",
        )
        self.page.largest = LARGEST
        self.page.loop.smooth = False
        self.page.loop.clock = clock
        self.log, self.clock = run.path / LOG, clock
        self.since, self.spent, self.refreshed = clock(), 0.0, -REFRESH
        look.add(self.page)
        self.curves = self._add_curves()
        overlays.add(self.page, None)
        self.page.listen()

    def step(self) -> None:
        """Draw what somebody who looks waits for, within the share of time."""
        loop = self.page.loop
        now = self.clock()
        if not loop.visitors:
            self.since, self.spent = now, 0.0
            return
        if now - self.refreshed > REFRESH:
            self.refreshed = now
            self._show_curves()
            loop.change()
        if self.spent > SHARE * (now - self.since):
            return
        loop.step()
        self.spent += self.clock() - now

    def _add_curves(self) -> dict[str, Any]:
        from viser import uplot

        gui, empty = self.page.server.gui, np.zeros(1)
        x_axis = uplot.Series(label="iteration")
        with gui.add_folder("Training"):
            return {
                name: gui.add_uplot(
                    data=(empty, empty),
                    series=(
                        x_axis,
                        uplot.Series(label=name, stroke=colour, width=2),
                    ),
                    scales={"x": uplot.Scale(time=False, auto=True), "y": uplot.Scale(auto=True)},
                    title=name,
                    aspect=2.0,
                )
                for name, colour in CURVES.items()
            }

    def _show_curves(self) -> None:
        rows = read_log(self.log)
        iteration = np.array([row["iteration"] for row in rows], np.float64)
        for name, plot in self.curves.items():
            if len(rows) > 1:
                plot.data = (iteration, np.array([row[name] for row in rows], np.float64))


def read_log(path: Path) -> list[dict[str, Any]]:
    """The whole lines of a log that have all that is plotted."""
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
        try:
            row = json.loads(line)
        except ValueError:  # being written
            continue
        if all(isinstance(row.get(name), int | float) for name in ("iteration", *CURVES)):
            rows.append(row)
    return rows
