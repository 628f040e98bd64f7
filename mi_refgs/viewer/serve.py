"""`refgs view`: everything ready before the page is served, then pictures until it is stopped."""

from __future__ import annotations

import dataclasses
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation.evaluate import load_split
from mi_refgs.runs.export import newest
from mi_refgs.runs.run import DATASET, Run
from mi_refgs.viewer import resolution, saving
from mi_refgs.viewer.controls import light, look, materials, overlays, truth
from mi_refgs.viewer.loop import added
from mi_refgs.viewer.mitsuba_scene import MitsubaScene
from mi_refgs.viewer.page import Page, Views
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.tonemap import DisplayOptions, shown_planes, to_bytes
from mi_refgs.viewer.viewer_scene import SampleRequest, ViewerScene

USUAL_SHAPES = (1.0, 1.6)
"""Shapes of the pictures that are compiled before a page asks: of small and of large desktop windows, less
the panel at their side."""

Tell = Callable[[str], None]


def serve_run(
    run: Run, host: str, port: int, output: Path | None = None, data: Path | None = None, tell: Tell = print
) -> Page:
    """A page of a run, ready to be opened, with the views of its data set as far as they are there.

    Nothing is written into the run. Raises InputError for a folder that is no run or holds no fit, for a port
    that is taken, and without viser.
    """
    views = views_of(run, data, tell)
    some = views.test or views.train
    scene = newest(run, run.method())
    drawable = ReconstructionView(scene, None if some is None else some.region)
    page = Page(drawable, views, run.path.resolve().name, host, port, output or run.path / "views")
    page.side = warm_up(drawable, page.look, page.start(), tell)
    look.add(page)
    light.add(page, drawable)
    materials.add(page, drawable)
    overlays.add(page, scene)
    truth.add(page)
    saving.add(page)
    page.listen()
    return page


def serve_scene(scene: Any, path: Path, host: str, port: int, output: Path | None, tell: Tell) -> Page:
    """A page of a loaded Mitsuba scene, drawn by its own integrator; raises InputError as `serve_run`."""
    drawable = MitsubaScene(scene, str(path))
    page = Page(drawable, Views(), path.name, host, port, output or path.parent / "views", drawable.start())
    page.side = warm_up(drawable, page.look, page.start(), tell)
    look.add(page)
    light.add(page, drawable)
    saving.add(page)
    page.listen()
    return page


def views_of(run: Run, data: Path | None, tell: Tell) -> Views:
    """The views of a run's data set, or of that in `data`; without what cannot be read, which is told."""
    method, found = run.method(), Views()
    if data is None and not (run.path / DATASET).is_file():
        return found
    for split in ("train", "test"):
        try:
            some: Dataset = load_split(run, method, split, data, decode=False)
            found = dataclasses.replace(found, **{split: some})
        except InputError as error:
            if data is not None:
                raise
            tell(f"{error}; shown without {split} views")
    return found


def warm_up(drawable: ViewerScene, look: DisplayOptions, pose: Pose, tell: Tell) -> int:
    """Compile the kernels of all sizes that a desktop window needs; returns the rung to begin moving at."""
    tell("preparing: compiling for each size of picture")
    chosen = resolution.COARSEST
    for shape, side in itertools.product(USUAL_SHAPES, resolution.SIDES):
        if side > resolution.FINEST:
            continue
        sample = SampleRequest(pose, *resolution.size_of(side, shape), look, settled=True)
        sums = added([], drawable.draw(sample).planes)
        begin = time.monotonic()
        sums = added(sums, drawable.draw(sample).planes)
        to_bytes(shown_planes(sums, look), sample.width, sample.height)
        if time.monotonic() - begin < resolution.SLOW:
            chosen = max(side, chosen)
    dr.sync_thread()
    dr.flush_malloc_cache()
    return chosen
