"""Pages of `refgs view`, ready to be opened."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.io.files import make_folder
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.reconstruction.reconstruction import Reconstruction
from mi_refgs.runs.export import newest
from mi_refgs.runs.run import DATASET, Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run, with_poses
from mi_refgs.viewer import resolution
from mi_refgs.viewer.comparison import add_comparison
from mi_refgs.viewer.loop import added
from mi_refgs.viewer.mitsuba_scene import MitsubaScene
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.painting_panel import PaintingPanel, WriteMasks
from mi_refgs.viewer.panels import MaterialsPanel, add_display, add_light, add_overlays
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.region_panel import RegionPanel
from mi_refgs.viewer.saving import add_saving
from mi_refgs.viewer.tonemap import displayed_planes, to_bytes
from mi_refgs.viewer.viewer_scene import SampleRequest

USUAL_SHAPES = (1.0, 1.6)
"""Aspect ratios of the images that are compiled beforehand: of small and of large desktop windows, less the
panel at their side."""

Tell = Callable[[str], None]


def serve_run(
    run: Run,
    address: tuple[str, int],
    output: Path | None = None,
    data: Path | None = None,
    tell: Tell = print,
) -> Page:
    """Return the page of a run, with the views of its data set, or of that in `data`.

    Nothing is written into the run. Raises InputError for a folder that is no run or has no fit, for a port
    that is taken, and without viser.
    """
    found = splits_of(run, data, tell)
    some = found.get("test") or found.get("train")
    trained = newest(run, run.method())
    scene = ReconstructionView(trained, None if some is None else some.region)
    page = Page(scene, found, run.path.resolve().name, address, output or run.path / "views")
    warm_up(page, tell)

    def write_masks(chosen: np.ndarray, folder: Path | None) -> list[Path]:
        source = Provenance.of(run).with_data(data)
        target = folder or source.data or run.path
        make_folder(target)
        return Reconstruction(trained, source, run.path).export("masks", target, where=chosen)

    add_panels(page, scene, trained, write_masks)
    return page


def serve_scene(scene: Any, path: Path, address: tuple[str, int], output: Path | None, tell: Tell) -> Page:
    """Return the page of a loaded Mitsuba scene; raises InputError as `serve_run`."""
    shown = MitsubaScene(scene, str(path))
    page = Page(shown, {}, path.name, address, output or path.parent / "views", shown.start())
    warm_up(page, tell)
    add_panels(page, shown)
    return page


def add_panels(
    page: Page,
    scene: ReconstructionView | MitsubaScene,
    trained: TrainedScene | None = None,
    write_masks: WriteMasks | None = None,
) -> None:
    """Add all panels that a scene has something for, and accept pages."""
    add_display(page)
    add_light(page, scene)
    if isinstance(scene, ReconstructionView) and scene.materials:
        MaterialsPanel(page, scene)
    add_overlays(page, trained)
    add_comparison(page)
    views = page.data.get("train") or page.data.get("test")
    if views is not None and views.region is not None:
        RegionPanel(page, views, views.region)
    if views is not None and write_masks is not None and isinstance(scene, ReconstructionView):
        if scene.original.surroundings is not None or not views.has_alpha:
            PaintingPanel(page, scene, views, write_masks)
    add_saving(page)
    page.listen()


def splits_of(run: Run, data: Path | None, tell: Tell) -> dict[str, Dataset]:
    """Return the splits of a run's data set, or of that in `data`; tells which cannot be read."""
    method, found = run.method(), dict[str, Dataset]()
    if data is not None or (run.path / DATASET).is_file():
        for split in ("train", "test"):
            try:
                views = views_of_run(run, method, split, data)
                found[split] = with_poses(views, run.cameras())
            except InputError as error:
                if data is not None:
                    raise
                tell(f"{error}; shown without {split} views")
    return found


def warm_up(page: Page, tell: Tell) -> None:
    """Compile the kernels of all sizes that a desktop window needs; choose the first level during motion."""
    tell("preparing: compiling for each image size")
    fastest, look = resolution.COARSEST, page.loop.look
    for shape, side in itertools.product(USUAL_SHAPES, resolution.SIDES):
        if side > resolution.FINEST:
            continue
        sample = SampleRequest(page.start(), *resolution.size_of(side, shape), look, settled=True)
        sums = added([], page.scene.draw(sample).planes)
        begin = time.monotonic()
        sums = added(sums, page.scene.draw(sample).planes)
        to_bytes(displayed_planes(sums, look), sample.width, sample.height)
        if time.monotonic() - begin < resolution.SLOW:
            fastest = max(side, fastest)
    dr.sync_thread()
    dr.flush_malloc_cache()
    page.moving_side = fastest
