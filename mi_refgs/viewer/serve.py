"""Pages of `refgs view`, ready to be opened."""

import itertools
import time
from pathlib import Path

import drjit as dr

from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.io.progress import say
from mi_refgs.runs.export import newest
from mi_refgs.runs.run import CAMERAS, DATASET, Run
from mi_refgs.runs.views import views_of_run, with_poses
from mi_refgs.viewer import resolution
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.panels import MaterialsPanel, add_cameras, add_display, add_light, add_saving
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.region_panel import RegionPanel


def serve(run: Run, address: tuple[str, int], output: Path | None, data: Path | None) -> Page:
    """Return the page of a run, with the views of its data set, or of that in `data`; writes nothing. Raises
    InputError for a folder that is no run or has no fit, for a port that is taken, and without viser."""
    found = splits_of(run, data)
    some = found.get("train") or found.get("test")
    scene = ReconstructionView(newest(run, run.method()), None if some is None else some.region)
    page = Page(scene, found, run.path.resolve().name, address, output or run.path / "views")
    warm_up(page)
    add_display(page)
    add_light(page, scene)
    if scene.materials:
        MaterialsPanel(page, scene)
    add_cameras(page)
    if some is not None and some.region is not None:
        RegionPanel(page, some, some.region)
    add_saving(page, scene)
    page.server.on_client_connect(page.connected)
    page.server.on_client_disconnect(lambda client: page.loop.clients.pop(client.client_id, None))
    return page


def splits_of(run: Run, data: Path | None) -> dict[str, Dataset]:
    """Return the splits of a run's data set, or of that in `data`; says which cannot be read."""
    method, found = run.method(), dict[str, Dataset]()
    if data is not None or (run.path / DATASET).is_file():
        for split in ("train", "test"):
            try:
                found[split] = with_poses(views_of_run(run, method, split, data), run.record(CAMERAS))
            except InputError as error:
                if data is not None:
                    raise
                say(f"{error}; shown without {split} views")
    return found


def warm_up(page: Page) -> None:
    """Compile the kernels of images during motion; choose their first level."""
    say("preparing: compiling for each image size")
    # Aspect ratios of desktop windows less the panel, and the first levels.
    for shape, side in itertools.product((1.0, 1.6), resolution.SIDES[:4]):
        camera = page.start().camera(*resolution.size_of(side, shape))
        for _ in range(2):
            begin = time.monotonic()
            dr.eval(page.scene.draw(camera, page.loop.look, True))
            dr.sync_thread()
        if time.monotonic() - begin < resolution.SLOW:
            page.moving_side = max(side, page.moving_side)
    dr.flush_malloc_cache()
