"""The region of interest and the masks of a page, without a browser: displayed, changed, written."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.region import Region, read_region
from mi_refgs.fitting.exchange import depth_outside
from mi_refgs.io.ownership import RUN, OutputFolder
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.painting_panel import PaintingPanel
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.region_panel import RegionPanel, adjusted, save_region, support_planes, wireframe
from mi_refgs.viewer.serve import add_panels
from mi_refgs.viewer.tonemap import DisplayOptions
from mi_refgs.viewer.viewer_scene import SampleRequest
from tests.helpers import refused
from tests.scenes.known import with_background
from tests.scenes.tiny import REGION, write_open_data

BOX = tuple((*(sign * axis).tolist(), -0.6) for sign in (1, -1) for axis in np.eye(3))
TABLE = (0.0, 0.0, 1.0, -0.2)
FITTED = Region((0.1, 0.2, 0.3), 1.0, (TABLE, *BOX))


@pytest.fixture
def data(tmp_path: Path) -> Dataset:
    """Photographs with a region of interest."""
    return read_dataset(write_open_data(tmp_path / "data"), "train")


# ---------------- the region ----------------


@pytest.mark.parametrize("planes", [(), (TABLE,), (TABLE, *BOX)])
def test_the_wireframe_is_on_the_border(planes: tuple[tuple[float, float, float, float], ...]) -> None:
    region = replace(FITTED, planes=planes)
    lines = wireframe(region)
    assert len(lines) > 300 and np.abs(depth_outside(lines.reshape(-1, 3), region)).max() < 1e-3
    sides = [np.isclose(lines[..., :] @ plane[:3], plane[3]).all(axis=1) for plane in planes]
    hidden = [i for i, side in enumerate(sides) if side.sum() < 50]
    assert hidden == ([3] if len(planes) > 1 else [])  # the box's lower side is below the table


def test_a_box_follows_the_sphere_and_the_table_stays(rng: np.random.Generator) -> None:
    assert support_planes(FITTED.planes) == (TABLE,) and support_planes(()) == ()
    assert support_planes((TABLE, (0, 0, -1, -1))) == (TABLE, (0, 0, -1, -1))
    region = adjusted(FITTED, np.array([1.0, 0.5, 0.3]), 2.0, [0.05])
    assert region.centre == (1.0, 0.5, 0.3) and region.radius == 2.0
    assert region.planes[0] == pytest.approx((0, 0, 1, -0.15))
    points = rng.uniform(-1.5, 1.5, (2000, 3))
    moved = (points - FITTED.centre) * 2 + region.centre
    box, grown = (replace(each, planes=each.planes[1:]) for each in (FITTED, region))
    np.testing.assert_array_equal(box.contains(points), grown.contains(moved))
    assert adjusted(FITTED, np.array(FITTED.centre), 1.0, [0.0]).is_close(FITTED)


def test_a_saved_region_is_that_of_the_next_fit(data: Dataset) -> None:
    """Also far from the origin, where positions are relative to an offset."""
    file = data.path / "region.json"
    file.unlink()
    far = replace(data, offset=(1000.0, 0.0, 0.0))
    assert f"refgs train {data.path} -o RUN" in save_region(replace(FITTED, estimated=True), far)
    found = read_region(data.path)
    assert found is not None and not found.estimated and found.is_close(FITTED.moved(np.array(far.offset)))
    save_region(REGION, data)
    assert read_dataset(data.path, "test").region == REGION


def test_a_region_of_others_is_replaced_only_if_it_is_named(data: Dataset, tmp_path: Path) -> None:
    file = data.path / "region.json"
    before = file.read_text()
    refused(lambda: save_region(FITTED, data), str(file), f"type {file} as region file to replace it")
    assert file.read_text() == before
    save_region(FITTED, data, file)
    assert json.loads(file.read_text())["radius"] == 1.0
    other = tmp_path / "other.json"
    assert f"move it to `{file}`" in save_region(FITTED, data, other) and other.is_file()
    OutputFolder(tmp_path / "run", RUN).claim("region.json")
    (tmp_path / "run/region.json").write_text("{}")
    refused(lambda: save_region(FITTED, data, tmp_path / "run/region.json"), "belongs to a run")


# ---------------- pages ----------------


@pytest.fixture
def page(scene: TrainedScene, data: Dataset, tmp_path: Path) -> Iterator[Page]:
    """A page of photographs; nothing is drawn."""
    displayed = ReconstructionView(with_background(scene, 0.2))
    made = Page(displayed, {"train": data}, "a page", ("127.0.0.1", 0), tmp_path / "views")
    yield made
    made.close()


def test_the_region_of_a_page_is_displayed_changed_and_saved(page: Page) -> None:
    data = page.data["train"]
    panel = RegionPanel(page, data, FITTED)
    panel.update()
    assert not panel.lines and not panel.arrows.visible and not page.loop.look.overlays
    panel.show.value, panel.radius.value, panel.heights[0].value = True, 0.5, 0.1
    panel.arrows.position = np.array([0.0, 0.2, 0.3])
    page.loop.step()
    wanted = adjusted(FITTED, np.array([0.0, 0.2, 0.3]), 0.5, [0.1])
    assert panel.region.is_close(wanted) and "radius 0.5" in panel.note.content
    np.testing.assert_allclose(panel.lines.points, wireframe(wanted), atol=1e-6)
    assert page.loop.look.overlays
    panel.file.value = str(data.path / "region.json")
    panel.save()
    assert "next: `refgs train" in panel.note.content
    found = read_region(data.path)
    assert found is not None and found.is_close(wanted)
    panel.show.value = False
    panel.update()
    assert not panel.lines.visible and not page.loop.look.overlays


def test_a_painted_object_is_highlighted_and_masked(page: Page, tmp_path: Path) -> None:
    scene, written = page.scene, list[tuple[np.ndarray, Path | None]]()
    assert isinstance(scene, ReconstructionView)

    def write(chosen: np.ndarray, folder: Path | None) -> list[Path]:
        written.append((chosen, folder))
        return [tmp_path / "masks/a.png"]

    panel = PaintingPanel(page, scene, page.data["train"], write)
    refused(panel.write, "nothing is painted")
    pose, window = Pose.looking_at(np.zeros(3), np.array([0, -3.0, 0]), 0.8), (640, 400)
    request = SampleRequest(pose, 64, 40, DisplayOptions(backdrop="background"))

    def image() -> np.ndarray:
        return np.array([np.array(plane) for plane in scene.draw(request).planes])

    before = image()
    panel.paint(pose, window, np.array([0.0, 0.0]), np.array([1.0, 0.5]), remove=False)
    position = scene.original.surfels.to_numpy()["position"]
    assert scene.highlighted is not None and (scene.highlighted == (position[:, 2] > 0)).mean() > 0.85
    changed = np.abs(image() - before).max(axis=0).reshape(40, 64) > 0.05
    assert changed[:18].sum() > 50 and not changed[23:].any()
    plain = replace(request, look=replace(request.look, what="normal"))
    assert scene.draw(plain).planes is not None
    panel.write()
    assert written[0][1] is None and (written[0][0] == scene.highlighted).all()
    assert "wrote 1 masks" in panel.note.content and "refgs train" in panel.note.content

    # A click of the brush is a circle, however wide the window is.
    panel.paint(pose, window, np.array([0.0, 0.0]), np.array([1.0, 1.0]), remove=True)
    assert scene.highlighted is None and np.array_equal(image(), before)
    panel.brush.value = 0.1
    centre = np.array([0.5 - 0.5 / 3 / np.tan(0.4) / 2 / 1.6, 0.5])
    panel.paint(pose, window, centre, centre, remove=False)
    hit = position[panel.painting.chosen]
    reach = np.abs(hit - (-0.5, -0.5, 0)).max(axis=0)
    assert 0.15 < reach[0] < 0.35 and 0.15 < reach[2] < 0.35


def test_panels_of_photographs_are_added(page: Page, scene: TrainedScene) -> None:
    assert isinstance(page.scene, ReconstructionView)
    add_panels(page, page.scene, None, lambda chosen, folder: [])
    labels = {getattr(c, "label", "") for c in page.server.gui._gui_input_handle_from_uuid.values()}
    assert {"Border", "Radius", "Save region", "Brush", "Write masks", "Undo"} <= labels
