"""`refgs train`: fit surfels, materials and an environment map to a data set."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import (
    Flag,
    MethodName,
    Output,
    Preset,
    Rendering,
    Result,
    Settings,
    joined,
    optional,
)
from mi_refgs.cli.view import HOST, PORT, Port
from mi_refgs.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Train:
    """Writes checkpoints, previews, metrics.jsonl, and finally surfels.ply, envmap.exr, mesh.ply, scene.xml.

    example:
      refgs train data/glossy -o runs/glossy --preset quick --set loss.alpha=0.1
    """

    data: Annotated[Positional[Path], arg(metavar="DATA")]
    """data set: a folder of images with cameras"""
    output: Output
    """run folder"""
    method: MethodName = None
    purpose: Annotated[str | None, optional("{photographs,relighting}", name="for")] = None
    """choose the method by a purpose"""
    preset: Preset = None
    set: Settings = ()
    resume: Flag = False
    """continue from the newest checkpoint, if there is one"""
    watch: Flag = False
    """display images and curves of the fit in the browser"""
    port: Port = PORT
    common: Rendering = Rendering()

    def run(self) -> Result:
        """Fit, from the start or from the newest checkpoint."""
        from mi_refgs.fitting.decide import table
        from mi_refgs.fitting.runner import method_for
        from mi_refgs.reconstruction.fit import ProgressBar, fit

        if self.purpose is not None and self.method is not None:
            what = f"{self.purpose}: --method {self.method} is given"
            raise InputError(what, "--for", remedy="give one of the two")
        progress = ProgressBar()
        if self.watch:
            from mi_refgs.viewer.training import TrainingViewer

            progress = TrainingViewer(HOST, self.port)

        begin, method, settings = time.monotonic(), self.method, joined(self.set)
        if self.purpose is not None:
            method = method_for(self.data, self.purpose, self.preset, settings, progress.say)
        given: dict[str, Any] = {"preset": self.preset, "output": self.output, "resume": self.resume}
        fit(self.data, method, settings=settings, progress=progress, **given)
        taken, trainer = time.monotonic() - begin, progress.trainer
        assert trainer is not None

        data: dict[str, Any] = {
            "run": str(self.output),
            "method": trainer.method.name,
            "preset": trainer.method.preset,
            "iterations": trainer.iteration,
            "seconds": round(trainer.fit.seconds, 3),
            "total_seconds": round(taken, 3),
            "surfels": trainer.surfels.count,
            "loss": trainer.statistics()["loss"],
        }
        around = trainer.surroundings
        beside = "" if around is None else f" and {around.surfels.count} of the background"
        text = (
            f"{self.output}: {trainer.iteration} iterations in {trainer.fit.seconds:.0f} s "
            f"({taken:.0f} s in all), {trainer.surfels.count} surfels{beside}; next: refgs eval {self.output}"
        )
        if trainer.fit.decisions:
            data["decisions"] = trainer.fit.decisions
            if any(row["psnr_with"] for row in trainer.fit.decisions):  # a trial that measured a gain
                text = f"{table(trainer.fit.decisions)}\n{text}"
        return Result(data, text)
