"""Points between known cameras, for fits to start from."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.capture import colmap, triangulate
from mi_refgs.data.dataset import Dataset, PointCloud, read_dataset
from mi_refgs.fitting.runner import begin
from mi_refgs.methods import load
from mi_refgs.runs.run import Run
from tests.helpers import read_loaded, with_pixels
from tests.scenes import photographed as scene
from tests.scenes.layouts import write_transforms

COUNT = 10
pytestmark = pytest.mark.skipif(not colmap.installed(), reason='pip install "mi_refgs[capture]"')


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Images with the cameras that took them, no points, no alpha."""
    folder, frames = tmp_path_factory.mktemp("known"), []
    for i, shot in enumerate(scene.around(COUNT)):
        scene.save(folder / f"{i}.png", scene.photograph(shot))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = shot.rotation.T @ np.diag([1.0, -1, -1]), shot.origin
        frames.append({"file_path": f"{i}.png", "transform_matrix": pose.tolist()})
    return read_loaded(write_transforms(folder, frames, fl_x=scene.FOCAL), "train")


@pytest.fixture(scope="module")
def points(data: Dataset) -> PointCloud:
    """What is found."""
    found = triangulate.triangulated(data)
    assert found is not None
    return found


def test_triangulated_points_are_on_the_surfaces(data: Dataset, points: PointCloud) -> None:
    position = points.position
    planes = [abs(position[:, 2]), abs(position[:, 2] - scene.BLOCK[2])]
    planes += [abs(abs(position[:, i]) - scene.BLOCK[i]) for i in (0, 1)]
    assert len(position) > 300
    off = np.min(planes, axis=0)
    assert np.median(off) < 0.005 and np.quantile(off, 0.95) < 0.03
    # Their colours are linear, and those of the images there.
    view = data.views[COUNT // 2]
    row, column, seen = view.project(position)
    shown = view.colour(data.background)[row[seen].astype(int), column[seen].astype(int)]
    assert points.colour is not None
    assert np.corrcoef(shown.ravel(), points.colour[seen].ravel())[0, 1] > 0.6
    assert abs(np.median(shown) - np.median(points.colour)) < 0.1


def test_triangulated_points_are_independent_of_downscale(data: Dataset, points: PointCloud) -> None:
    """Features come from images read again, in full, whatever the size of the fit; and runs are
    repeatable."""
    found = triangulate.triangulated(read_dataset(data.path, "train", downscale=2))
    assert found is not None
    np.testing.assert_array_equal(found.position, points.position)


def test_fit_starts_from_triangulated_points(
    data: Dataset, points: PointCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are found once a run, and said; the surfels of the start lie around them."""
    said: list[str] = []
    method = load("base_2dgs", "quick", ["surfels.count=200", "data.downscale=1"])
    calls: list[Dataset] = []

    def found(data: Dataset) -> PointCloud:
        calls.append(data)
        return points

    monkeypatch.setattr(triangulate, "triangulated", found)
    trainer = begin(method, data, Run(tmp_path / "run"), said.append, triangulate.with_points)
    assert f"{len(points.position)} points to start from" in said[0]
    assert trainer.data.points is not None
    np.testing.assert_array_equal(trainer.data.points.position, points.position)
    again = triangulate.with_points(data, tmp_path / "run", said.append)
    assert again is not None and len(calls) == 1
    np.testing.assert_array_equal(again.position, points.position)
    file = tmp_path / "run" / triangulate.POINTS_FILE
    whole = file.read_bytes()
    for size in (0, 10, len(whole) // 2, len(whole) - 1):
        file.write_bytes(whole[:size])
        assert triangulate.with_points(data, tmp_path / "run", said.append) is points
    for at in range(100, len(whole), len(whole) // 20):  # whatever was damaged
        file.write_bytes(whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :])
        assert triangulate.with_points(data, tmp_path / "run", said.append) is not None
    file.write_bytes(whole)
    calls.clear()
    turned = replace(data.views[0], to_world=data.views[1].to_world)
    for other in (replace(data, path=tmp_path), replace(data, views=(turned, *data.views[1:]))):
        assert triangulate.with_points(other, tmp_path / "run", said.append) is points
    assert len(calls) == 2


def test_triangulation_is_skipped_where_useless(
    data: Dataset, points: PointCloud, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(triangulate, "triangulated", None)
    said: list[str] = []
    masked = [with_pixels(view, alpha=np.ones_like(view.image[..., 0])) for view in data.views]
    assert triangulate.with_points(replace(data, views=tuple(masked)), tmp_path, said.append) is None
    assert triangulate.with_points(replace(data, points=points), tmp_path, said.append) is points
    small = replace(data, views=tuple(view.averaged(4) for view in data.views))
    assert triangulate.with_points(small, tmp_path, said.append) is None
    assert not said
    monkeypatch.setattr(colmap, "installed", lambda: False)
    assert triangulate.with_points(data, tmp_path, said.append) is None
    assert 'pip install "mi_refgs[capture]"' in said[0]


def test_images_without_texture_have_no_points(data: Dataset, tmp_path: Path) -> None:
    folder = tmp_path / "flat"
    for i in range(COUNT):
        scene.save(folder / f"{i}.png", np.full((scene.HEIGHT, scene.WIDTH, 3), 90, np.uint8))
    (folder / "transforms_train.json").write_bytes((data.path / "transforms_train.json").read_bytes())
    (folder / "transforms_test.json").write_bytes((data.path / "transforms_train.json").read_bytes())
    said: list[str] = []
    flat = read_dataset(folder, "train")
    assert triangulate.with_points(flat, tmp_path / "run", said.append) is None
    assert "too little texture" in said[0]


def test_near_pairs_are_close_views(data: Dataset) -> None:
    pairs = triangulate.near_pairs(data.views)
    assert {(i, i + 1) for i in range(COUNT - 1)} <= set(pairs)
    assert len(pairs) < COUNT * (COUNT - 1) / 2 and all(i < j for i, j in pairs)
