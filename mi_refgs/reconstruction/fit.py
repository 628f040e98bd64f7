"""Fit a `Reconstruction` to a data set, with previews in the run folder and a bar in the terminal."""

import math
import shutil
import tempfile
import warnings
import weakref
from dataclasses import replace
from pathlib import Path

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation.images import RenderedView, contact_sheet, light_panels, panels
from mi_refgs.fitting import runner
from mi_refgs.fitting.runner import Progress
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import write_png
from mi_refgs.io.progress import progress_bar, say, warn
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.methods.method import Method
from mi_refgs.reconstruction.reconstruction import Reconstruction, load
from mi_refgs.runs.run import Run


def fit(
    data: str | Path | Dataset,
    method: str | Path | Method | None = None,
    *,
    preset: str | None = None,
    settings: runner.Settings = (),
    purpose: str | None = None,
    light: str | Path | None = None,
    light_fixed: bool = False,
    turntable: bool = False,
    output: str | Path | None = None,
    resume: bool = False,
    force: bool = False,
    progress: bool | Progress = True,
) -> Reconstruction:
    """Fit surfels, materials and an environment map to the images in folder `data`, as `refgs train` does.

    data: or the training views in memory, `Dataset.from_mitsuba` or those of `read_dataset` after a change.
    The run of one that no folder has does not keep it: give its test views to `evaluate`, and a folder to
    commands (--data).
    method: a method of the package (`variants/`), the path of a .toml, or a `Method`; None fits what the
    scene needs of the full method (`auto`), and to images without alpha background Gaussians too. preset: how
    long, "quick", "standard" (the default), "paper", or iterations and largest number of surfels,
    "1000:20000". settings: changes of the method, {"loss.ssim": 0.1} or ["loss.ssim=0.1"]. purpose:
    "photographs" or "relighting", in place of a method.

    light: a lat-long map (EXR, HDR, PNG, JPEG) with which the light starts, or which it is if `light_fixed`.
    Its first row is straight up, +z, unless it is the data set's environment.exr. The settings
    `light.world`, `light.rotate` and `light.exposure` are as in `Reconstruction.relight`; `light.learn`
    is some of "rotation" and "scale", of a fixed map. turntable: the object turned before a fixed camera and
    lamp, so that the light turns with the camera; the result has the light of the first one. Images need
    alpha or masks.

    output: the run folder. Without one a temporary folder is used, which is removed with the last
    `Reconstruction` of it; `save` keeps the result. resume: continue the run in `output`;
    other arguments are those that it was started with, or absent. force: fit data that the checks before a
    fit refuse, such as cameras that contradict their points. progress: True shows messages and a bar on
    standard error, False only Python's warnings; a `Progress` is called after each step.

    Raises InputError for bad input, and KeyboardInterrupt with a message that says where the checkpoints are.
    """
    require_supported_variant("mi_refgs.fit")
    listener = progress if isinstance(progress, Progress) else ProgressBar(quiet=not progress)
    temporary = None
    if output is None:
        if resume:
            raise InputError("there is no run to continue", "resume", remedy="give its folder as `output`")
        temporary = _TemporaryFolder()
        output = temporary.path
        listener.say(f"{output}: the run, removed with its last Reconstruction; `save` keeps one")
    try:
        source = data if isinstance(data, Dataset) else Path(data)
        folder = source.path if isinstance(source, Dataset) else source
        settings = [*_light_settings(light, light_fixed, folder), *methods.assignments(settings)]
        settings += ["light.turntable=true"] * turntable
        named = str(method) if isinstance(method, Path) else method
        choice = runner.Choice(named, preset, settings, purpose, force)
        runner.fit(source, Path(output), choice, resume=resume, progress=listener)
    except (KeyboardInterrupt, InputError):
        if temporary is not None and Run(temporary.path).checkpoints():  # from which it can be resumed
            temporary.remove.detach()
        raise
    return replace(load(output), _temporary=temporary)


def _light_settings(file: str | Path | None, fixed: bool, data: Path) -> list[str]:
    """The assignments of a method whose light is a file."""
    if file is None:
        if fixed:
            raise InputError("no map is given", "--light-fixed", remedy="give its file as --light")
        return []
    path, own = Path(file).resolve(), data / "environment.exr"
    world = path.is_file() and own.is_file() and path.read_bytes() == own.read_bytes()
    chosen = {"file": str(path), "kind": "file", "fixed": fixed, "world": world}
    return methods.assignments({f"light.{key}": value for key, value in chosen.items()})


class _TemporaryFolder:
    """A folder that is removed with this object, at the latest when the process ends."""

    def __init__(self) -> None:
        self.path = Path(tempfile.mkdtemp(prefix="refgs_"))
        self.remove = weakref.finalize(self, shutil.rmtree, self.path, ignore_errors=True)


class ProgressBar(Progress):
    """Write previews/<iteration>.png into the run folder, and show a progress bar and messages on standard
    error; `quiet`: Python's warnings alone."""

    def __init__(self, quiet: bool = False) -> None:
        self.quiet, self.bar = quiet, progress_bar(0, "", disable=True)
        self.psnr = math.nan

    def say(self, message: str) -> None:
        if not self.quiet:
            say(message)

    def warn(self, message: str) -> None:
        if self.quiet:
            warnings.warn(message, stacklevel=2)
        else:
            warn(message)

    def begin(self, trainer: Trainer) -> None:
        super().begin(trainer)
        method, options = trainer.method, {"initial": trainer.iteration, "smoothing": 0.05}
        self.bar = progress_bar(method.iterations, method.name, disable=self.quiet, **options)

    def step(self, trainer: Trainer) -> None:
        iteration, method = trainer.iteration, trainer.method
        if not self.quiet and iteration % method.log_every == 0:
            numbers = trainer.statistics()
            new = float(numbers["psnr"])
            self.psnr = new if math.isnan(self.psnr) else 0.9 * self.psnr + 0.1 * new  # a running mean
            text = f"loss {numbers['loss']:.4f}, PSNR {self.psnr:.1f} dB, {numbers['surfels']} surfels"
            self.bar.set_postfix_str(text, refresh=False)
        is_due = iteration % method.preview_every == 0 or iteration == method.iterations
        if trainer.run is not None and is_due:
            # The first training view and the environment map.
            view = trainer.data.views[0].load()
            rendered = RenderedView.of(trainer.view(trainer.camera(0)), trainer.data, view)
            map_ = None if trainer.fit.light is None else trainer.fit.light.environment()
            light = None if map_ is None else light_panels(map_.radiance().numpy())
            image = contact_sheet([panels(rendered, view)], light)
            write_png(trainer.run.path / f"previews/{iteration:07d}.png", image)
        self.bar.update(iteration - self.bar.n)  # the trial of a component takes many iterations

    def end(self) -> None:
        self.bar.close()
