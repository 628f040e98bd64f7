"""Stereo: points on the surfaces of photographs with known cameras."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from mi_refgs.data import stereo as sweep
from mi_refgs.data.dataset import Dataset, PointCloud
from mi_refgs.data.region import Region
from mi_refgs.data.stereo import Stereo, stereo
from mi_refgs.fitting.initialisers import along_pixels
from mi_refgs.fitting.runner import begin
from mi_refgs.methods import load
from mi_refgs.methods.extensions import Wanted
from mi_refgs.runs.run import Run
from tests.helpers import read_loaded, with_pixels
from tests.scenes import photographed as scene
from tests.scenes.layouts import write_transforms

COUNT = 12
REGION = Region((0.0, 0.0, 0.4), 1.2)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Images with the cameras that took them, no points, no alpha."""
    folder, frames = tmp_path_factory.mktemp("known"), []
    for i, shot in enumerate(scene.around(COUNT)):
        scene.save(folder / f"{i}.png", scene.photograph(shot, samples=2))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = shot.rotation.T @ np.diag([1.0, -1, -1]), shot.origin
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    return read_loaded(write_transforms(folder, frames, fl_x=scene.FOCAL), "train")


@pytest.fixture(scope="module")
def found(data: Dataset) -> Stereo:
    found = stereo(data.views, REGION)
    assert found is not None
    return found


def off_surface(position: np.ndarray) -> np.ndarray:
    """Distance from the ground, or from the plane of a side of the block: (N,)."""
    planes = [abs(position[:, 2]), abs(position[:, 2] - scene.BLOCK[2])]
    planes += [abs(abs(position[:, i]) - scene.BLOCK[i]) for i in (0, 1)]
    return np.asarray(np.min(planes, axis=0))


def test_points_are_on_the_surfaces(data: Dataset, found: Stereo) -> None:
    """Some of them are spaced evenly: one point in a voxel of contracted space."""
    points, voxel = found.points, np.floor(REGION.contract(found.spaced) / sweep.VOXEL)
    assert len(points.position) > 2000 and len(np.unique(voxel, axis=0)) == len(found.spaced) > 1000
    for position in (points.position, found.spaced):
        off = off_surface(position)
        assert np.median(off) < 0.013 and np.quantile(off, 0.9) < 0.038  # observed .011 and .036
    # On the block as on the ground, with the linear colours of the images there.
    assert np.count_nonzero(points.position[:, 2] > scene.BLOCK[2] - 0.05) > 100
    view = data.views[COUNT // 2]
    row, column, seen = view.project(points.position)
    shown = view.colour(data.background)[row[seen].round().astype(int), column[seen].round().astype(int)]
    assert points.colour is not None
    assert np.corrcoef(shown.ravel(), points.colour[seen].ravel())[0, 1] > 0.6
    assert abs(np.median(shown) - np.median(points.colour)) < 0.1


def test_correlation_is_that_of_the_patches() -> None:
    rng = np.random.default_rng(0)
    grey, seen = rng.random((9, 11)), rng.random((2, 9, 11))
    mean = sweep.uniform_filter(grey, sweep.PATCH)
    variance = sweep.uniform_filter(grey * grey, sweep.PATCH) - mean * mean
    found = sweep._correlation(grey, mean, variance, seen)
    reach = sweep.PATCH // 2
    for row, column in ((4, 5), (2, 8)):
        patch = slice(row - reach, row + reach + 1), slice(column - reach, column + reach + 1)
        for one, value in zip(seen, found[:, row, column], strict=True):
            expected = np.corrcoef(grey[patch].ravel(), one[patch].ravel())[0, 1]
            assert value == pytest.approx(expected, abs=1e-9)


def test_images_without_texture_have_no_points(data: Dataset) -> None:
    flat = [with_pixels(view, image=np.full_like(view.image, 0.4)) for view in data.views[:3]]
    assert stereo(flat, REGION) is None and stereo(data.views[:2], REGION) is None


def test_other_pixels_are_the_rest(data: Dataset, found: Stereo) -> None:
    """Their rays pass through the pixels' centres, and have their colours; the plain sky is among them."""
    rays = found.unknown
    view = data.views[3].averaged(2)
    mine = np.flatnonzero((rays.origin == view.to_world[:3, 3]).all(axis=1))
    row, column, seen = view.project(rays.origin[mine] + 5 * rays.direction[mine])
    np.testing.assert_allclose(row, row.round(), atol=1e-6)
    np.testing.assert_allclose(view.depth_of(rays.origin[mine] + 5 * rays.direction[mine]), 5)
    assert seen.all() and len(mine) < view.width * view.height
    colour = view.colour(np.zeros(3))[row.round().astype(int), column.round().astype(int)]
    np.testing.assert_allclose(rays.colour[mine], colour, atol=1e-6)
    assert 0.02 < np.mean(rays.origin[:, 2] + 100 * rays.direction[:, 2] > 0) < 1


def test_fit_of_stereo(data: Dataset, found: Stereo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside the points of the data set; images without texture have those only."""
    method, said, swept = load("photographs", "8:400", ["data.downscale=1"]), list[str](), Mock()
    swept.return_value = found
    monkeypatch.setattr("mi_refgs.fitting.runner.stereo", swept)
    trainer = begin(method, data, Run(tmp_path / "run"), said.append)
    assert any("found by stereo" in text for text in said)
    begin(method, data, Run(tmp_path / "run"))  # killed before a checkpoint: the same points
    assert [call.args[1] for call in swept.call_args_list] == [data.region] * 2 != [trainer.data.region] * 2
    assert np.median(off_surface(trainer.surfels.position().numpy().T)) < 0.2
    # Random points of the background: on rays of the other pixels, outside of the region, behind its centre.
    assert trainer.data.region is not None
    wanted = Wanted(300, trainer.data, np.random.default_rng(0), 1.0, trainer.data.region, inside=False)
    start = along_pixels(wanted)
    assert start is not None
    placed, colour = start.position, start.colour
    assert not trainer.data.region.contains(placed).any() and len(placed) == len(colour) == 300
    assert {tuple(row) for row in colour} <= {tuple(row) for row in found.unknown.colour}
    # Points of its own.
    own = replace(data, points=PointCloud(np.array([[0.0, 0, 5]])))
    both = begin(method, own, Run(tmp_path / "own"), said.append).data.points
    assert both is not None and both.colour is None
    assert len(both.position) == 1 + len(found.points.position)
    # Without texture.
    monkeypatch.setattr("mi_refgs.fitting.runner.stereo", lambda *_: None)
    said.clear()
    none = begin(method, data, Run(tmp_path / "none"), said.append)
    assert none.data.points is None and any("too little texture" in text for text in said)
