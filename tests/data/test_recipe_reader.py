"""CONTRIBUTING's recipe "add a reader", followed: a layout of this test's own, from the folder to a fit."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import mi_refgs
from mi_refgs.cli import main
from mi_refgs.data.dataset import READERS, PointCloud, ReadOptions, Recording, held_out, read_dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.io.images import box_downscale, read_png, write_png
from mi_refgs.surfels.ply import read_ply
from tests.scenes.tiny import RADIUS, train_command, write_data, write_method


class TableReader:
    """`cameras.txt` has a line per image: file, focal length in pixels, the 12 numbers of a pose."""

    name = "table of cameras"
    looks_for = "cameras.txt"

    def recognises(self, folder: Path) -> bool:
        return (folder / "cameras.txt").is_file()

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        lines = [line.split() for line in (folder / "cameras.txt").read_text().splitlines()]
        views = [self._view(folder, line, options.downscale) for line in held_out(lines, split)]
        points = np.loadtxt(folder / "points.txt", ndmin=2)
        return Recording(tuple(views), PointCloud(points), source=folder / "cameras.txt")

    def _view(self, folder: Path, line: list[str], downscale: float) -> View:
        image = np.ascontiguousarray(box_downscale(read_png(folder / line[0]), downscale)[..., :3])
        height, width = image.shape[:2]
        focal, *pose = map(float, line[1:])
        to_world = np.vstack([np.reshape(pose, (3, 4)), [0, 0, 0, 1]])
        pinhole = (focal / downscale, focal / downscale, width / 2, height / 2)
        return View(line[0], width, height, *pinhole, to_world, Pixels(image))


@pytest.fixture
def folder(tmp_path: Path) -> Iterator[Path]:
    """The views of the tiny ball in the new layout: 9 training images and 2 test images, no alpha."""
    views = read_dataset(write_data(tmp_path / "ball", views=11, truth=False), "train").views
    out = tmp_path / "table"
    out.mkdir()
    lines = []
    for i, view in enumerate(views):
        write_png(out / f"{i}.png", view.load().image)
        lines.append(" ".join(map(str, [f"{i}.png", view.fx, *view.to_world[:3].ravel()])))
    (out / "cameras.txt").write_text("\n".join(lines))
    directions = np.random.default_rng(0).normal(size=(300, 3))
    np.savetxt(out / "points.txt", RADIUS * directions / np.linalg.norm(directions, axis=1, keepdims=True))
    mi_refgs.register_reader(TableReader())
    yield out
    READERS.unregister(TableReader.name)


def test_registered_layout_is_read_and_fitted(folder: Path, tmp_path: Path) -> None:
    train, test = read_dataset(folder, "train"), read_dataset(folder, "test", downscale=2)
    assert (len(train.views), len(test.views)) == (9, 2) and test.views[0].width == train.views[0].width // 2
    assert read_dataset(folder, "train", pixels=100).downscale == 2
    run = tmp_path / "run"
    assert main(train_command(folder, run, write_method(tmp_path))) == 0
    position = read_ply(run / "surfels.ply").to_numpy()["position"]
    assert np.abs(np.linalg.norm(position, axis=1) - RADIUS).mean() < 0.1 * RADIUS
    assert main(["eval", str(run)]) == 0
