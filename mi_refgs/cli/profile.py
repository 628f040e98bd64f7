"""`refgs profile`: times of a training step and of a frame, and advice."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from mi_refgs.cli.command import MethodName, OtherData, Preset, Rendering, Result, Settings, joined, optional
from mi_refgs.errors import InputError
from mi_refgs.progress import say

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.profiling.profile import FrameProfile, Profile
    from mi_refgs.runs.run import Run

MOST_STEPS = 1000
MOST_PIXELS = 4096
MEBIBYTE = 2**20


@dataclass(frozen=True, kw_only=True)
class ProfileCommand:
    """A run is measured at its newest checkpoint, with its frames; a data set in every stage of a new fit.

    Nothing is written.

    example:
      refgs profile runs/glossy
    """

    path: Annotated[Positional[Path], arg(metavar="RUN|DATA")]
    """run folder or data set"""
    steps: Annotated[int, arg(metavar="N")] = 15
    """steps to measure"""
    size: Annotated[tuple[int, ...], optional("N …")] = ()
    """with RUN: pixels along the longer side of its frames (default: 200 400 800)"""
    data: OtherData = None
    method: MethodName = None
    preset: Preset = None
    set: Settings = ()
    common: Rendering = Rendering()

    def run(self) -> Result:
        """Measure, and advise."""
        import drjit as dr

        from mi_refgs.profiling.advice import advice
        from mi_refgs.profiling.profile import profile
        from mi_refgs.runs.run import Run
        from mi_refgs.runs.trained_scene import MODEL

        if not 1 <= self.steps <= MOST_STEPS:
            raise InputError(f"--steps: {self.steps} is out of range; give 1 to {MOST_STEPS}")
        for size in self.size:
            if not 1 <= size <= MOST_PIXELS:
                raise InputError(f"--size: {size} is out of range; give 1 to {MOST_PIXELS}")
        folder = Run(self.path)
        has_scene = folder.exists() and (bool(folder.checkpoints()) or (self.path / MODEL).is_file())
        # Bad input of a fit is refused before the frames, which take longest.
        fit = None if has_scene and not folder.checkpoints() else self._trainer(folder)
        frames = self._frames(folder, has_scene)
        data: dict[str, Any] = {
            "frames": [asdict(frame) for frame in frames],
            "threads": int(dr.thread_count()),
        }
        if fit is None:
            return Result(data, frames_text(frames))
        trainer, stages = fit
        found = profile(trainer, stages, self.steps)
        advised = advice(found, trainer.method)
        data |= asdict(found) | {"advice": advised}
        data["work"]["share"] = found.work.share
        return Result(data, "\n\n".join([text(found, advised), *([frames_text(frames)] if frames else [])]))

    def _frames(self, folder: Run, has_scene: bool) -> list[FrameProfile]:
        """Measure frames of a run at each size; none for a data set, or a run without a checkpoint."""
        from mi_refgs.profiling.profile import SIZES, aovs_of, profile_frame
        from mi_refgs.reconstruction.reconstruction import load

        if self.size and not folder.exists():
            raise InputError(f"--size: {self.path} is no run; drop --size")
        if not has_scene:
            return []
        found = load(self.path, write=False)
        draw, camera = found.trained.drawn(), found.camera(0)
        names = aovs_of(draw(camera, True))
        return [profile_frame(draw, names, camera.resized(size)) for size in self.size or SIZES]

    def _trainer(self, folder: Run) -> tuple[Trainer, list[str]]:
        """Return the trainer of a run or of a new fit, and the stages of the schedule to measure."""
        from mi_refgs.fitting.runner import load_method
        from mi_refgs.fitting.train import Trainer
        from mi_refgs.runs.views import read_views, sized, views_of_run

        if not self.path.is_dir():
            raise InputError(f"{self.path}: RUN|DATA: no such folder; give a run folder or a data set")
        if folder.exists():
            for option in ("method", "preset", "set"):
                if getattr(self, option):
                    raise InputError(
                        f"--{option}: {self.path} is a run and keeps its method; drop --{option}"
                    )
            method = folder.method()
            if not folder.checkpoints():
                raise InputError(f"{self.path}: checkpoints: none yet; train on, or profile its data set")
            trainer = Trainer(method, views_of_run(folder, method, "train", self.data), folder)
            return trainer, [method.stage_at(max(trainer.iteration, 1))[0]]
        if self.data is not None:
            raise InputError(f"--data: {self.path} is no run; drop --data")
        method = sized(load_method(self.method, self.preset, joined(self.set)), self.path, say)
        views = read_views(method, self.path, "train", truth=False)
        return Trainer(method, views), [name for name, _ in method.stages()]


def text(found: Profile, advised: list[str]) -> str:
    """Return the profile as text: a table of milliseconds, counts, and advice."""
    names = list(dict.fromkeys(name for stage in found.stages for name in stage.phases_ms))
    lines = [_row("a training step, ms", [stage.name for stage in found.stages])]
    for name in names:
        lines.append(_row(f"  {name}", [f"{stage.phases_ms.get(name, 0):.2f}" for stage in found.stages]))
    sums = [sum(stage.phases_ms.values()) for stage in found.stages]
    lines.append(_row("  sum, between barriers", [f"{ms:.2f}" for ms in sums]))
    lines.append(_row("undisturbed step", [f"{stage.step_ms:.2f}" for stage in found.stages]))
    lines.append(_row("kernel launches", [f"{stage.launches:.0f}" for stage in found.stages]))
    lines.append(_row("kernels compiled, warm", [f"{stage.misses}" for stage in found.stages]))
    work = found.work
    counts = [
        ("surfels", f"{work.surfels}"),
        ("pixels", f"{work.pixels:.0f}, {work.covered / work.pixels:.0%} covered"),
        ("surfel-tile pairs", f"{work.pairs:.0f}"),
        ("surfel-pixel evaluations", f"{work.evaluated:.0f}"),
        ("  that contribute", f"{work.contributing:.0f} ({work.share:.0%})"),
        ("layers per covered pixel", f"{work.contributing / max(work.covered, 1):.1f}"),
        ("surfels in no view", f"{work.unseen_share:.0%}"),
        ("memory of the kernels", f"{found.allocated / MEBIBYTE:.0f} MiB at most"),
    ]
    lines += ["", f"per view, mean of {work.views}", *(f"{name:<28}{value}" for name, value in counts), ""]
    return "\n".join([*lines, *(advised or ["Nothing stands out."])])


def frames_text(frames: list[FrameProfile]) -> str:
    """Return a table of milliseconds per frame and AOV."""
    lines = [_row("a frame, ms", [f"{frame.width}x{frame.height}" for frame in frames])]
    lines.append(_row("  radiance and alpha", [f"{frame.frame_ms:.1f}" for frame in frames]))
    for name in frames[0].aovs_ms:
        lines.append(_row(f"  + {name}", [f"{frame.aovs_ms[name]:.1f}" for frame in frames]))
    return "\n".join(lines)


def _row(name: str, cells: list[str]) -> str:
    return f"{name:<28}" + "".join(f"{cell:>12}" for cell in cells)
