"""A whole fit beside its loop: pictures read as the method says, a run begun or resumed, its artefacts."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs.data.dataset import Dataset, fitting_downscale, read_dataset
from mi_refgs.data.readers import PointCloud
from mi_refgs.data.survey import require_several_sides
from mi_refgs.errors import InputError
from mi_refgs.fitting.exposure import EXPOSURE_FILE
from mi_refgs.fitting.select import DECISIONS, select_terms, with_terms
from mi_refgs.fitting.state import decisions_of
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import Method
from mi_refgs.methods.presets import PRESETS
from mi_refgs.runs.export import up_to_date
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import MODEL

SAME_REGION = 1e-6
"""Difference of two regions, in radii, up to which they are the same: solvers differ in the last digits."""


def sized(method: Method, path: Path, tell: Callable[[str], None] = lambda _: None) -> Method:
    """The method with the size of pictures decided: where it says none, what its preset can afford.

    `tell` is called when pictures are read smaller than they are. Raises InputError as `read_dataset` does.
    """
    if method.data.downscale is not None:
        return method
    budget = PRESETS[method.preset].pixels if method.preset in PRESETS else sys.maxsize
    factor, width, height = fitting_downscale(path, method.data.images, budget)
    if factor > 1:
        tell(
            f"{path}: pictures of {width} × {height} pixels are read as {width // factor} × "
            f"{height // factor}, so that preset {method.preset} takes its time and not more; "
            "--set data.downscale=1 reads them whole"
        )
    return replace(method, data=replace(method.data, downscale=factor))


def read_views(method: Method, path: Path, split: str, truth: bool = True, decode: bool = True) -> Dataset:
    """A split of the data set at `path` as the method asks for its pictures; the others as in `read_dataset`.

    Raises InputError as `read_dataset` does.
    """
    options = method.data
    return read_dataset(
        path,
        split,
        downscale=options.downscale,
        background=options.background,
        images=options.images,
        truth=truth,
        decode=decode,
    )


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
        method = with_terms(method, decisions_of(state))
    else:
        require_several_sides(views)
        for note in views.notes:
            tell(f"{views.path}: {note}")
        if find_points is not None:
            views = replace(views, points=find_points(views, run.path, tell))
    trainer = Trainer(method, views, run, state)
    trainer.exposure.tell = tell
    if resumed:
        run.rewind(trainer.iteration)
    else:
        run.create(method, str(views.path.resolve()), views.region)
    select_terms(trainer, tell)
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
    if trainer.decisions:
        run.write_method(trainer.method)
        run.write_json(DECISIONS, trainer.decisions)
    if (exposure := trainer.exposure.record()) is not None:
        run.write_json(EXPOSURE_FILE, exposure)
    warning = None
    try:
        first = read_views(trainer.method, trainer.data.path, "test").views[0]
    except InputError as error:
        warning = f"{error} (scene.xml gets a training camera, and `refgs eval` will need test views)"
        first = trainer.data.views[0]
    up_to_date(run, trainer.method, first.camera())
    return warning
