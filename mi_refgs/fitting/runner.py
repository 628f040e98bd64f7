"""A whole fit beside its loop: pictures read as the method says, a run begun or resumed, its artefacts."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs import methods
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.data.dataset import Dataset, PointCloud
from mi_refgs.data.survey import few_views, require_several_sides
from mi_refgs.errors import InputError
from mi_refgs.fitting import exposure
from mi_refgs.fitting.plan import planned
from mi_refgs.fitting.progress import Progress
from mi_refgs.fitting.select import DECISIONS, select_components, with_components
from mi_refgs.fitting.state import decisions_of
from mi_refgs.fitting.targets import read_views
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.resources import resource_dir
from mi_refgs.methods.method import Method
from mi_refgs.runs.export import up_to_date
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import MODEL

SAME_REGION = 1e-6
"""Difference of two regions, in radii, up to which they are the same: solvers differ in the last digits."""


Tell = Callable[[str], None]
"""Is called with sentences for the user."""
FindPoints = Callable[[Dataset, Path, Tell], PointCloud | None]
"""Finds points for a fit to start from, and keeps them in the folder: `capture.triangulate.with_points`."""


def begin(
    method: Method,
    views: Dataset,
    run: Run,
    tell: Tell = lambda _: None,
    find_points: FindPoints | None = None,
) -> Trainer:
    """A trainer that writes into `run`: from its newest checkpoint if the folder holds a run, else anew.

    A new fit starts from what `find_points` finds, by default the points of the data set. `tell` is called
    with what is found, and what is decided about the terms of a method that selects them. A run that is
    resumed keeps its region of interest. Raises InputError for cameras that all stand in one place,
    checkpoints that are all damaged, a scene that no checkpoint is of, and a folder that cannot be written.
    """
    resumed = run.exists()
    views = of_run(run, views, tell)
    state = run.load_checkpoint() if resumed else None
    if resumed and state is None and (run.path / MODEL).is_file():
        raise InputError(
            f"{run.path}: checkpoints: none, but a scene that was edited, imported or copied, which a fit "
            "would replace; choose another -o"
        )
    if state is not None:
        method = with_components(method, decisions_of(state))
    else:
        require_several_sides(views)
        for note in views.notes:
            tell(f"{views.path}: {note}")
        if find_points is not None:
            views = replace(views, points=find_points(views, run.path, tell))
    trainer = Trainer(method, views, run, state)
    trainer.tell = tell
    if resumed:
        run.rewind(trainer.iteration)
    else:
        run.create(method, str(views.path.resolve()), views.region)
    select_components(trainer, tell)
    return trainer


def of_run(run: Run, views: Dataset, tell: Callable[[str], None] = lambda _: None) -> Dataset:
    """The views with the region of interest that the run was started with, where it records one.

    `tell` is called if the data set has another one. Raises InputError as `Run.region` does.
    """
    region, now = run.region(), views.region
    if region is None:
        return views
    change = (
        np.inf if now is None else np.subtract((*now.centre, now.radius), (*region.centre, region.radius))
    )
    if np.abs(change).max() > SAME_REGION * region.radius:
        tell(f"{views.path}: region: it has changed since {run.path} was started, which keeps its own")
    return replace(views, region=region)


def finish(trainer: Trainer, run: Run) -> str | None:
    """Save the state if no checkpoint holds it, and write the artefacts; returns a warning if there is one.

    Afterwards config.toml has the terms that were chosen. The first test view becomes the camera of
    scene.xml, and a training view where there are no test views.
    """
    if not any(int(path.stem) == trainer.iteration for path in run.checkpoints()):
        run.save_checkpoint(trainer.iteration, trainer.state())
    if trainer.fit.decisions:
        run.write_method(trainer.method)
        run.write_json(DECISIONS, trainer.fit.decisions)
    if (gains := exposure.record(trainer.setup, trainer.fit)) is not None:
        run.write_json(exposure.EXPOSURE_FILE, gains)
    warning = None
    try:
        first = read_views(trainer.method, trainer.data.path, "test").views[0]
    except InputError as error:
        warning = f"{error} (scene.xml gets a training camera, and `refgs eval` will need test views)"
        first = trainer.data.views[0]
    up_to_date(run, trainer.method, first.camera())
    return warning


DEFAULT_METHOD = "ref_gaussian.toml"
"""File of `variants/` that is fitted when none is named: the full method."""
OPEN_PURPOSE = "photographs"
"""What the method that is fitted to pictures without alpha is for, when none is named."""

Settings = Mapping[str, object] | Sequence[str]
"""Changes of a method: {"loss.ssim": 0.1}, or as on the command line, ["loss.ssim=0.1"]."""


def fit(
    data: Path,
    output: Path,
    method: str | Method | None = None,
    *,
    preset: str | None = None,
    settings: Settings = (),
    resume: bool = False,
    minutes: float | None = None,
    progress: Progress | None = None,
    find_points: FindPoints | None = None,
) -> Trainer:
    """Fit, from the start or from the newest checkpoint, and write the artefacts; a finished run is loaded.

    method: a name, the path of a .toml, or None: the full method, and for pictures without alpha the one that
    fits their surroundings too. A `Method` is fitted as it is. preset: how long, "standard" if it is None.
    minutes: time that a new fit may take. resume: go on if the folder holds a run. Its method, preset,
    settings and size of images stay: what is given has to be the same. find_points: as in `begin`.

    Raises InputError for bad input, BusyError for a run that another process trains, and KeyboardInterrupt or
    TerminatedError with a message that says how to go on.
    """
    progress = progress or Progress()
    folder = Run(output)
    resumed = resume and folder.exists()
    if isinstance(method, Method) and (preset or settings):
        raise InputError("method: preset, settings: a Method has its own; change it, or name one")
    if minutes is not None and not 0 < minutes < math.inf:
        raise InputError(f"--minutes: {minutes} is no time; give more than 0")
    if resumed:
        chosen = folder.method()
        _require_same(folder, chosen, data, method, preset, settings, minutes)
    else:
        folder.require_none()
        if not isinstance(method, Method):
            method = method or default_method(data, preset, settings, progress)
            method = load_method(method, preset, settings)
        if minutes is not None and method.data.downscale is not None:
            raise InputError(
                f"--minutes: data.downscale={method.data.downscale} decides the size of images; drop either"
            )
        wanted = None if minutes is None else 60 * minutes
        chosen, progress.expected = planned(method, data, wanted, progress.say)
        if progress.expected is not None:
            progress.say(progress.expected.sentence(chosen.iterations))
    views = read_views(chosen, data, "train", truth=False)
    _warn_of_data(chosen, views, progress)
    with folder.alone():
        if not resumed:
            folder.require_none()
        return _fit(chosen, views, folder, progress, find_points)


def _fit(
    method: Method, views: Dataset, folder: Run, progress: Progress, find_points: FindPoints | None
) -> Trainer:
    """Train to the last iteration and write the artefacts, with the run to itself."""
    data, output, resumed = views.path, folder.path, folder.exists()
    if resumed:
        _say_if_moved(folder, data, progress)
    trainer = begin(method, views, folder, progress.say, find_points)
    if resumed:
        progress.say(f"{output}: resumed at iteration {trainer.iteration} of {method.iterations}")

    def step(trainer: Trainer) -> None:
        while trainer.notices:
            progress.warn(trainer.notices.pop(0))
        progress.step(trainer)

    progress.begin(trainer)
    try:
        trainer.train(step)
    except KeyboardInterrupt as error:
        kept = "" if folder.checkpoints() else " (before the first iteration was done)"
        raise type(error)(
            f"interrupted at iteration {trainer.iteration}{kept}; "
            f"resume with: refgs train {data} -o {output} --resume"
        ) from None
    except InputError as error:  # a full disk, no surfel left
        saved = folder.checkpoints()
        kept = f" (saved up to iteration {int(saved[-1].stem)}; --resume goes on from there)" if saved else ""
        raise InputError(f"{error}{kept}") from error
    finally:
        progress.end()
    if warning := finish(trainer, folder):
        progress.warn(warning)
    _warn_of_outcome(trainer, progress)
    return trainer


def load_method(method: str | None, preset: str | None, settings: Settings = ()) -> Method:
    """The method of a name or path, or the full one, at the preset for everyday use if that is None."""
    path = method or str(resource_dir("variants") / DEFAULT_METHOD)
    return methods.load(path, preset or DEFAULT_PRESET, methods.assignments(settings))


def default_method(
    data: Path, preset: str | None = None, settings: Settings = (), progress: Progress | None = None
) -> str | None:
    """The method for pictures without alpha, where the data set has such; None for the full one."""
    # What `settings` say of a method may be of the other one.
    of_data = [text for text in methods.assignments(settings) if text.startswith("data.")]
    views = read_views(load_method(None, preset, of_data), data, "train", truth=False, decode=False)
    if views.has_alpha or views.region is None:
        return None
    method = methods.for_purpose(OPEN_PURPOSE)
    (progress or Progress()).say(
        f"{data}: pictures without alpha: --method {method} fits their surroundings too"
    )
    return method


def _require_same(
    folder: Run,
    made: Method,
    data: Path,
    wanted: str | Method | None,
    preset: str | None,
    settings: Settings,
    minutes: float | None,
) -> None:
    """Raise InputError if what is given for a run that is resumed would have made another method of it."""
    changes, file = methods.assignments(settings), made.file
    if isinstance(wanted, Method):
        if wanted.select is not None and wanted.components != made.components:
            wanted = methods.load(wanted.file, wanted.preset, wanted.assignments, made.components)
        _require(folder, "method", made, wanted)
    elif wanted is not None:
        file = wanted
        now = methods.load(file, made.preset or DEFAULT_PRESET, made.assignments, made.components)
        _require(folder, "--method (--for)", made, now)
    if preset is not None and preset != made.preset:
        raise InputError(
            f"{folder.path / 'config.toml'}: --preset: the run was started with '{made.preset}', not "
            f"'{preset}'; drop --preset or choose another -o"
        )
    if changes and tuple(changes) != made.assignments:
        _require(folder, "--set", made, methods.load(file, made.preset, changes, made.components))
    if minutes is not None:
        free = replace(made, data=replace(made.data, downscale=None))
        _require(folder, "--minutes", made, planned(free, data, 60 * minutes)[0])


def _require(folder: Run, option: str, made: Method, now: Method) -> None:
    """Raise InputError if the method of a run is another one than an option asks for."""
    if now.data.downscale is None:  # decided when the run was started
        now = replace(now, data=replace(now.data, downscale=made.data.downscale))
    for key, (before, after) in methods.differences(made, now).items():
        raise InputError(
            f"{folder.path / 'config.toml'}: {option}: {key}: the run was started with {before}, and "
            f"would now have {after}; drop {option} or choose another -o"
        )


def _say_if_moved(folder: Run, data: Path, progress: Progress) -> None:
    """Warn of another data set, and record it: commands that follow read that of the last fit."""
    try:
        before = folder.dataset().resolve()
    except (OSError, ValueError, KeyError, TypeError):
        before = data.resolve()
    if before != data.resolve():
        progress.warn(f"{folder.path}: was fitted to {before} before, now to {data}")
        folder.write_dataset(str(data.resolve()), folder.region())


def _warn_of_data(method: Method, views: Dataset, progress: Progress) -> None:
    """Say what is unusual about a data set."""
    if note := few_views(len(views.views)):
        progress.warn(f"{views.path}: {note}")
    if not views.has_alpha and (method.surroundings is None or views.region is None):
        progress.warn(
            f"{views.path}: pictures without alpha: surfels start at random, "
            "and the background becomes surfels too"
        )


def _warn_of_outcome(trainer: Trainer, progress: Progress) -> None:
    """Say what is unusual about a finished fit."""
    options, count = trainer.method.surfels, trainer.surfels.count
    if trainer.method.refine.densify is not None and count >= options.max_count:
        progress.warn(
            f"all {count} surfels in use; more may help: --set surfels.max_count={2 * options.max_count}"
        )
    if count < options.count // 10:
        progress.warn(f"{count} of {options.count} surfels are left; look at the previews")
