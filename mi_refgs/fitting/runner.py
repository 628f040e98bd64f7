"""A fit from data to artefacts: chooses method and image size, begins or resumes a run, finishes it."""

import itertools
import re
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from mi_refgs import methods
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.data import checks, object_region as regions
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import REGION_FILE, region_pixels
from mi_refgs.data.stereo import stereo
from mi_refgs.errors import InputError
from mi_refgs.fitting.decide import HOLDOUT, as_decided, differences, waiting
from mi_refgs.fitting.per_view import gains_of
from mi_refgs.fitting.state import decisions_of
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.files import resource_dir
from mi_refgs.io.progress import Tell, command_line
from mi_refgs.methods.method import POSE, Method
from mi_refgs.registry import plugin_options
from mi_refgs.runs.export import write_if_stale
from mi_refgs.runs.run import CAMERAS, DECISIONS, EXPOSURE, Run
from mi_refgs.runs.trained_scene import MODEL
from mi_refgs.runs.views import as_read, changed, digests, options_of, read_views, sized, with_region
from mi_refgs.shade.light.placed import PlacedLight

DEFAULT_METHOD = "auto.toml"  # of `variants/`, fitted by default: what the scene needs of the full method
Settings = Mapping[str, object] | Sequence[str]
"""Changes of a method: {"loss.ssim": 0.1}, or as on the command line, ["loss.ssim=0.1"]."""


@dataclass(frozen=True)
class Choice:
    """What the user says about the method of a fit."""

    method: str | Method | None = None
    """A name, the path of a .toml, or None: what the scene needs of the full method, or for images without
    alpha the method that fits their background too. A `Method` is fitted as it is."""
    preset: str | None = None  # "standard" by default
    settings: Settings = ()
    purpose: str | None = None  # `about.purpose` of the method, in place of a name
    force: bool = False  # fit also what `checks` refuse

    def __post_init__(self) -> None:
        if isinstance(self.method, Method) and (self.preset or self.settings):
            what, remedy = "a Method has its own", "change it, or name one"
            raise InputError(what, "method", "preset, settings", remedy)
        if self.purpose is not None and self.method is not None:
            what = f"{self.purpose}: --method {self.method} is given"
            raise InputError(what, "--for", remedy="give one of the two")

    def named(self) -> str | None:
        """The name or path of the method, whatever the images; None: DEFAULT_METHOD."""
        assert not isinstance(self.method, Method)
        return self.method if self.purpose is None else methods.for_purpose(self.purpose)


class Progress:
    """A listener to a fit that displays nothing; subclasses override methods."""

    trainer: Trainer | None = None  # of the fit, also after its end

    def say(self, message: str) -> None:
        """Is called with messages about the fit and its decisions."""

    def warn(self, message: str) -> None:
        """Is called with warnings about the data or the fit."""

    def begin(self, trainer: Trainer) -> None:
        """Is called before the first step, also of a finished run. Overrides call this one."""
        self.trainer = trainer

    def step(self, trainer: Trainer) -> None:
        """Is called after each step. `trainer.statistics()` waits for the device, `.view(camera)` renders."""

    def end(self) -> None:
        """Is called after the last step, and when the fit is interrupted or fails."""


def fit(data: Path | Dataset, output: Path, choice: Choice, *, resume: bool, progress: Progress) -> Trainer:
    """Fit, from the start or from the newest checkpoint, and write the artefacts; a finished run is loaded.
    resume: continue the run in the folder; the choice has to be the run's own.

    Raises InputError for bad input, BusyError for a run that another process trains, and KeyboardInterrupt or
    TerminatedError with a message that says how to continue."""
    run = Run(output)
    if isinstance(data, Dataset):
        _require_read_so(data, choice.settings)
    if resume:
        if not run.exists():
            raise InputError("no run to continue", output, "--resume", "leave it out to start one")
        method = run.method()
        views = read_views(method, data, "train", truth=False)
        _require_same(run, method, choice, data, views)
    else:
        run.require_none()
        method, views = chosen(data, choice, progress.say)
    if not views.has_alpha and (method.surroundings is None or views.region is None):
        what = "surfels start at random, and model the background too"
        progress.warn(f"{views.path}: images without alpha: {what}")
    with run.alone():
        if not resume:  # asked again: another process may have begun a run while the data was read
            run.require_none()
        return _fit(method, views, run, progress, choice.force)


def chosen(data: Path | Dataset, choice: Choice, say: Tell = lambda _: None) -> tuple[Method, Dataset]:
    """The method of a new fit, with the size of images decided, and the training views; raises InputError."""
    if isinstance(choice.method, Method):
        return sized(choice.method, data, say)
    if choice.method is not None:
        return sized(load_method(choice.method, choice.preset, choice.settings), data, say)
    # Settings of anything but images may be those of the other method.
    named = choice.named()
    reads, views = sized(load_method(named, choice.preset, _of_images(choice.settings)), data, say)
    name = _for_images(named, reads, views)
    if name != named:
        say(f"{views.path}: images without alpha: fitted with their background, by --method {name}")
    return as_read(load_method(name, choice.preset, choice.settings), data, views), views


def _for_images(name: str | None, method: Method, views: Dataset) -> str | None:
    """The name of the method, for images without alpha its `about.without_alpha`."""
    return name if views.has_alpha or views.region is None else method.about.without_alpha or name


def _fit(method: Method, views: Dataset, run: Run, progress: Progress, force: bool) -> Trainer:
    """Train to the last iteration and write the artefacts, with the run locked."""
    output, resumed = run.path, run.exists()
    trainer = begin(method, views, run, progress.say, progress.warn, force)
    if resumed:
        # Commands that follow read the data set of the last fit.
        if (before := run.dataset()) is not None and str(before.resolve()) != views.folder:
            progress.warn(f"{output}: was fitted to {before.resolve()} before, now to {views.path}")
        run.write_dataset(views.folder, run.region())
        progress.say(f"{output}: resumed at iteration {trainer.iteration} of {method.iterations}")

    progress.begin(trainer)
    try:
        trainer.train(progress.step)
    except KeyboardInterrupt as error:
        kept = "" if run.checkpoints() else " (before the first iteration was done)"
        again = command_line("train", views.folder or "DATA", "-o", output, "--resume")
        what = f"interrupted at iteration {trainer.iteration}{kept}; resume with: {again}{plugin_options()}"
        raise type(error)(what) from None
    except InputError as error:  # a full disk, no surfel left
        saved = run.checkpoints()
        kept = f" (saved up to iteration {int(saved[-1].stem)}; --resume goes on from there)" if saved else ""
        raise InputError(f"{error}{kept}") from error
    finally:
        progress.end()
    if trainer.fit.turntable is not None:
        first = trainer.whole.views[0].name
        progress.say(f"{output}: the light turns with the camera; the files have the light of view '{first}'")
    if warning := finish(trainer, run):
        progress.warn(warning)
    options, count = trainer.method.surfels, trainer.surfels.count
    if count < options.count // 10:
        progress.warn(f"{count} of {options.count} surfels are left; look at the previews")
    return trainer


def begin(
    method: Method,
    views: Dataset,
    run: Run,
    tell: Tell = lambda _: None,
    warn: Tell = lambda _: None,
    force: bool = False,
) -> Trainer:
    """Create a trainer that writes into `run`, from its newest checkpoint if the folder contains a run.

    `tell` is called with what is found and decided, `warn` with steps that failed and what `checks` find.
    Raises InputError for data that they refuse unless `force`, damaged checkpoints, an unusable folder."""
    resumed = run.exists()
    views = views.relative_to(run.offset())
    if other := changed(views, run.images()):
        count = f"{len(other)} of {len({*run.images(), *other})}"
        what = f"not as when {run.path} began: {count} images or cameras"
        raise InputError(what, views.path, other[0], "restore them, or choose another -o")
    state, found = run.load_checkpoint() if resumed else None, list[checks.Finding]()
    if resumed and state is None and (run.path / MODEL).is_file():
        what = "none, but a scene that was edited, imported or copied, which a fit would replace"
        raise InputError(what, run.path, "checkpoints", "choose another -o")
    if state is not None:
        method = as_decided(method, decisions_of(state))
    else:
        turns = method.light is not None and method.light.turntable
        if turns and not views.has_alpha:
            what = "images without alpha, whose background does not turn with the object"
            remedy = "give masks: `refgs doctor DATA --masks` writes them before a plain backdrop"
            raise InputError(what, views.path, "--turntable", remedy)
        met = {"turntable": turns, "exposure": "exposure" in method.event}  # by what the method does
        found = checks.examine(views)
        checks.heed([one for one in found if not met.get(one.name)], warn, force)
        for note in views.notes:
            tell(f"{views.path}: {note}")
        for (_, before), (name, _) in itertools.pairwise(method.stages()):
            if before.until >= method.iterations:
                warn(f"stage {name}: does not begin in {method.iterations} iterations; add more")
        views, surfaces = _with_stereo(views, tell)
        if not resumed:
            views = _around_object(views, surfaces, tell, warn)
    views = with_region(views, run.region(began=True), tell)
    trainer = Trainer(method, views, run if resumed else None, state, tell=tell, warn=warn)
    if resumed:
        run.rewind(trainer.iteration)
    else:
        run.create(trainer.method, views.folder, views.region, digests(views), views.offset)
        trainer.run = run
        if trainer.fit.decisions:  # of before the first step
            run.write_json(DECISIONS, trainer.fit.decisions)
        run.write_json("checks.json", {one.name: one.numbers for one in found})
        left = waiting(trainer)
        if len(views.views) < HOLDOUT and left:
            few = f"{len(views.views)} views: too few to hold some out"
            tell(f"{views.path}: {few}, so {' and '.join(left)} are not decided")
        for name, in_time in left.items():
            if not in_time:
                warn(f"{name}: is not tried in {method.iterations} iterations; add more")
    return trainer


def _with_stereo(views: Dataset, tell: Tell) -> tuple[Dataset, np.ndarray | None]:
    """The data set with what stereo finds, and points (N, 3) spaced evenly on surfaces; not with alpha."""
    if views.has_alpha or views.region is None:
        return views, None
    began = time.perf_counter()
    if (found := stereo(views.views, views.region)) is None:
        tell(f"{views.path}: stereo: no points; the images have too little texture in common")
        return views, None
    points = found.points
    tell(f"{len(points.position)} points on surfaces, found by stereo in {time.perf_counter() - began:.0f} s")
    joined = points if views.points is None else views.points.followed_by(points)
    return replace(views, points=joined, unknown=found.unknown), found.spaced


def _around_object(views: Dataset, surfaces: np.ndarray | None, tell: Tell, warn: Tell) -> Dataset:
    """Adapt an estimated region of interest to points: those of stereo, `surfaces`, or else of the data."""
    region, points = views.region, views.points
    if region is None or views.has_alpha:
        return views
    if region.estimated and points is not None:
        seen, origins = partial(regions.seen_share, views.views), regions.camera_positions(views.views)
        shown, scatter = points.position, regions.SPARSE
        if surfaces is not None:
            shown, scatter = surfaces, regions.DENSE
        found = regions.object_region(region, origins, shown, seen, scatter)
        if found.supports:
            tell(f"{views.path}: region of interest: it ends above the plane that supports the object")
        if found.radius > region.radius:
            tell(f"{views.path}: region of interest: it has grown to {found.radius:.3g} units")
        if not regions.shown_whole(views.views, found, shown, scatter):
            warn(f"{views.path}: no image shows the whole object; add some from farther away")
        region = found
    if not any(region_pixels(view, region).any() for view in views.views):
        file, fields = views.path / REGION_FILE, "centre, radius, planes"
        raise InputError("no view shows the region", file, fields, "correct or remove them")
    return replace(views, region=region)


def finish(trainer: Trainer, run: Run) -> str | None:
    """Save the state if no checkpoint contains it, and write the artefacts; returns a warning, if any."""
    if not any(int(path.stem) == trainer.iteration for path in run.checkpoints()):
        run.save_checkpoint(trainer.iteration, trainer.fit.arrays())
    names = [view.name for view in trainer.data.views]
    if (gains := gains_of(trainer.fit.params)) is not None:
        run.write_json(EXPOSURE, {"gain": dict(zip(names, gains.round(5).tolist(), strict=True))})
    if POSE in trainer.fit.params:
        poses = {view.name: view.to_world.tolist() for view in map(trainer.posed, range(len(names)))}
        run.write_json(CAMERAS, {"to_world": poses})
    if isinstance(light := trainer.fit.light, PlacedLight):
        scale = [1] * 3 if light.scale is None else np.exp(light.scale.numpy()[0]).tolist()
        turn = np.array(light.world_from_map()).reshape(3, 3).tolist()
        run.write_json("light.json", {"world_from_map": turn, "scale": scale})
    if trainer.fit.region is not None:
        run.write_dataset(trainer.data.folder, trainer.fit.region)
    warning, camera = None, trainer.camera(0)
    try:
        if trainer.data.folder is not None:
            test = read_views(trainer.method, trainer.data.path, "test")
            camera = test.relative_to(trainer.data.offset).views[0].camera()
    except InputError as error:
        warning = f"{error} (scene.xml gets a training camera, and `refgs eval` will need test views)"
    write_if_stale(run, trainer.method, lambda _: camera)
    return warning


def load_method(method: str | None, preset: str | None, settings: Settings = ()) -> Method:
    """Load a method by name or path, by default DEFAULT_METHOD at the preset "standard"."""
    path = method or str(resource_dir("variants") / DEFAULT_METHOD)
    return methods.load(path, preset or DEFAULT_PRESET, methods.assignments(settings))


def _of_images(settings: Settings) -> list[str]:
    return [text for text in methods.assignments(settings) if re.match(r"\s*data\s*[.=]", text)]


def _require_read_so(views: Dataset, settings: Settings) -> None:
    """Raise InputError for a setting that views in memory were not read with."""
    given = _of_images(settings)
    asked = load_method(None, None, given).data
    for key, value in options_of(views).items():
        named = any(re.match(rf"\s*data\s*\.\s*{key}\b", text) for text in given)
        if named and getattr(asked, key) != value:
            what, remedy = f"the views were read with {value}", "drop it, or read them so"
            raise InputError(what, views.path, f"data.{key}", remedy)


def _require_same(run: Run, made: Method, choice: Choice, data: Path | Dataset, views: Dataset) -> None:
    """Raise InputError if what is given for a resumed run would have made another method of it."""
    now, first = choice.method, ["name", "preset"]
    if not isinstance(now, Method):
        name = choice.named()
        if choice.purpose is not None:
            name = _for_images(name, load_method(name, None), views)
        given = methods.assignments(choice.settings)  # other keys are the run's
        first += [text.partition("=")[0] for text in given]
        preset, asked = choice.preset or made.preset or DEFAULT_PRESET, name or choice.preset or given
        now = methods.load(name or made.file, preset, [*made.assignments, *given]) if asked else made
    now = as_read(now, data, views) if isinstance(data, Dataset) else now
    if found := differences(run, now):
        key = min(found, key=lambda key: [not key.startswith(one) for one in first])
        what = "the run was started with {}, and would now have {}".format(*found[key])
        raise InputError(what, run.path / "config.toml", key, "drop what says so, or choose another -o")
