"""The region panel of a page, without a browser: displayed, changed, written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.region import Region, read_region
from mi_refgs.fitting.exchange import depth_outside
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.region_panel import RegionPanel, adjusted, border, save_region
from tests.helpers import refused
from tests.scenes.tiny import REGION, write_open_data

BOX = tuple((*(sign * axis).tolist(), -0.6) for sign in (1, -1) for axis in np.eye(3))
TABLE = (0.0, 0.0, 1.0, -0.2)
FITTED = Region((0.1, 0.2, 0.3), 1.0, (TABLE, *BOX))


@pytest.fixture
def data(tmp_path: Path) -> Dataset:
    """Photographs with a region of interest."""
    return read_dataset(write_open_data(tmp_path / "data"), "train")


@pytest.mark.parametrize("planes", [(), (TABLE,), (TABLE, *BOX)])
def test_the_border_is_that_of_the_region(planes: tuple[tuple[float, float, float, float], ...]) -> None:
    region = replace(FITTED, planes=planes)
    mesh = border(region)
    assert mesh.is_watertight and np.abs(depth_outside(np.array(mesh.vertices), region)).max() < 0.02
    assert region.contains(mesh.sample(2000) * 0.98 + 0.02 * mesh.centroid).all()


def test_a_box_follows_the_sphere_and_the_table_stays(rng: np.random.Generator) -> None:
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
    (data.path / "region.json").unlink()
    far = replace(data, offset=(1000.0, 0.0, 0.0))
    assert f"refgs train {data.path} -o RUN" in save_region(replace(FITTED, estimated=True), far)
    found = read_region(data.path)
    assert found is not None and not found.estimated and found.is_close(FITTED.moved(np.array(far.offset)))
    save_region(REGION, data, again=True)
    assert read_dataset(data.path, "test").region == REGION


def test_a_region_of_others_is_not_replaced(data: Dataset) -> None:
    file = data.path / "region.json"
    before = file.read_text()
    refused(lambda: save_region(FITTED, data), str(file))
    run_of_before = replace(data, region=replace(REGION, estimated=True))  # the file came later
    refused(lambda: save_region(FITTED, run_of_before), str(file))
    assert file.read_text() == before


def test_a_page_changes_and_saves_its_region(scene: TrainedScene, data: Dataset, tmp_path: Path) -> None:
    page = Page(ReconstructionView(scene), {"train": data}, "a page", ("127.0.0.1", 0), tmp_path / "views")
    try:
        panel = RegionPanel(page, data, FITTED)
        assert not panel.lines and not panel.arrows.visible
        panel.show.value, panel.radius.value, panel.heights[0].value = True, 0.5, 0.1
        panel.arrows.position = np.array([0.0, 0.2, 0.3])
        page.loop.step()
        wanted = adjusted(FITTED, np.array([0.0, 0.2, 0.3]), 0.5, [0.1])
        assert panel.region.is_close(wanted) and "radius 0.5" in panel.note.content
        np.testing.assert_allclose(panel.lines.vertices, border(wanted).vertices, atol=1e-6)
        (data.path / "region.json").unlink()
        panel.save()
        assert "next: `refgs train" in panel.note.content
        found = read_region(data.path)
        assert found is not None and found.is_close(wanted)
        panel.show.value = False
        page.loop.step()
        assert not panel.lines.visible
    finally:
        page.close()
