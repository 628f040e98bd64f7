"""`refgs train`: fit surfels, materials and an environment map to a data set."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import Flag, MethodName, Output, Preset, Rendering, Result, Settings, optional
from mi_refgs.io.progress import command_line
from mi_refgs.registry import plugin_options


@dataclass(frozen=True, kw_only=True)
class Train:
    """Writes checkpoints, previews, metrics.jsonl, and finally surfels.ply, envmap.exr, mesh.ply, scene.xml.

    example:
      refgs train data/glossy -o runs/glossy --preset quick --set loss.alpha=0.1"""

    data: Annotated[Positional[Path], arg(metavar="DATA")]  # data set: a folder of images with cameras
    output: Output  # run folder
    method: MethodName = None
    purpose: Annotated[str | None, optional("{photographs,relighting}", name="for")] = None
    """choose the method by a purpose"""
    preset: Preset = None
    light: Annotated[Path | None, optional("FILE")] = None
    """start with this lat-long map (EXR, HDR) as the light; its first row is straight up, +z"""
    light_fixed: Flag = False  # do not change the map of --light
    turntable: Flag = False
    """the object turned before a fixed camera and lamp: the light turns with the camera"""
    set: Settings = ()
    resume: Flag = False  # continue the run from its newest checkpoint
    force: Flag = False  # fit data that the checks before a fit refuse
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.reconstruction.fit import ProgressBar, fit

        progress = ProgressBar()
        begin = time.monotonic()
        names = "preset", "output", "resume", "purpose", "light", "light_fixed", "force", "turntable"
        given: dict[str, Any] = {name: getattr(self, name) for name in names}
        fit(self.data, self.method, settings=sum(self.set, ()), progress=progress, **given)
        taken, trainer = time.monotonic() - begin, progress.trainer
        assert trainer is not None
        data: dict[str, Any] = {"run": str(self.output), "method": trainer.method.name}
        data |= {"preset": trainer.method.preset, "iterations": trainer.iteration}
        data |= {"seconds": round(trainer.fit.seconds, 3), "total_seconds": round(taken, 3)}
        data |= {"surfels": trainer.surfels.count, "loss": trainer.statistics()["loss"]}
        around = trainer.fit.surroundings
        beside = "" if around is None else f" and {around.surfels.count} of the background"
        text = (
            f"{self.output}: {trainer.iteration} iterations in {trainer.fit.seconds:.0f} s "
            f"({taken:.0f} s in all), {trainer.surfels.count} surfels{beside}; "
            f"next: {command_line('eval', self.output)}{plugin_options()}"
        )
        if trainer.fit.decisions:
            data["decisions"] = trainer.fit.decisions
        return Result(data, text)
