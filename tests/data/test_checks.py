"""Checks before a fit: cameras against points, and images against those of neighbouring cameras."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mi_refgs.cli import main
from mi_refgs.data.checks import Finding, examine, heed
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.lens import Lens
from mi_refgs.data.region import Region
from mi_refgs.data.survey import write_masks
from mi_refgs.errors import InputError
from mi_refgs.io.images import read_png, write_png
from mi_refgs.runs.views import changed, digests
from tests.helpers import refused
from tests.scenes.layouts import change_transforms, write_colmap
from tests.scenes.tiny import train_command, write_data, write_method

VIEWS, SIZE, FOCAL, NO_LENS = 16, np.array([480, 360]), 450.0, Lens(False, (0.0, 0.0, 0.0))
Number = Callable[[int], float]  # of a camera


def write_model(
    folder: Path,
    shift: Number = lambda i: 0.0,  # pixels, of the keypoints
    turn: Number = lambda i: 0.0,  # radians, about the scene
    copies: int = 1,  # times that images are smaller than what was reconstructed
    lens: Lens = NO_LENS,
    origin: float = 0.0,
    mirror: int = 1,
) -> Path:
    """A COLMAP model of cameras around points with exact keypoints, but for what is given."""
    points, images = np.random.default_rng(3).uniform(-0.6, 0.6, (60, 3)), list[str]()
    for i in range(VIEWS):
        rotation = Rotation.from_euler("yx", [2 * np.pi * i / VIEWS, 0.3]).as_matrix().T
        x, y, z = rotation @ points.T + [[0], [0], [4]]
        u, v = FOCAL * np.stack(lens.distort(x / z, y / z)) + SIZE[:, None] / 2 + [[shift(i)], [0]]
        rotation = Rotation.from_euler("y", turn(i)).as_matrix() @ rotation
        qx, qy, qz, qw = Rotation.from_matrix(rotation).as_quat()
        place = [0, 0, 4 * mirror] - rotation @ np.full(3, origin)
        images.append(f"{i + 1} {qw} {qx} {qy} {qz} {' '.join(map(str, place))} 1 {i:02d}.png")
        images.append(" ".join(f"{a} {b} {k + 1} 0 0 -1" for k, (a, b) in enumerate(zip(u, v, strict=True))))
        write_png(folder / f"images/{i:02d}.png", np.full((*(SIZE[::-1] // copies), 3), 0.2 + 0.1 * (i % 2)))
    numbers = (*SIZE, FOCAL, FOCAL, *SIZE / 2, *lens.radial[:2], *lens.tangential)
    (folder / "sparse/0").mkdir(parents=True)
    for name, lines in {
        "cameras": [f"1 OPENCV {' '.join(map(str, numbers))}"],
        "images": images,
        "points3D": [f"{k} {' '.join(map(str, p + origin))} 9 9 9 0.5" for k, p in enumerate(points, 1)],
    }.items():
        (folder / f"sparse/0/{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


def refuse(what: str) -> None:
    raise InputError(what, "data", "checks", "none")


def found_in(data: Path) -> dict[str, Finding]:
    return {one.name: one for one in examine(read_dataset(data, "train", truth=False))}


@pytest.mark.parametrize(
    ("given", "result", "median", "views"),
    [
        ({}, "fine", 0.0, 0),
        ({"lens": Lens(False, (-0.2, 0.05, 0.0), (0.01, 0.02))}, "fine", 0.0, 0),
        ({"copies": 3}, "fine", 0.0, 0),
        ({"origin": 5e5}, "fine", 0.0, 0),
        ({"shift": lambda i: 1.5}, "fine", 1.5, 0),
        ({"shift": lambda i: 5}, "said", 5.0, 14),
        ({"shift": lambda i: 12 * (i == 3)}, "said", 0.0, 1),
        ({"shift": lambda i: 12}, "refused", 12.0, 14),
        ({"shift": lambda i: 12, "copies": 3}, "refused", 4.0, 14),
        ({"turn": lambda i: 0.35 * (i % 3 == 2)}, "refused", 0.0, 4),
    ],
)
def test_points_are_compared_with_keypoints(
    given: dict[str, Any], result: str, median: float, views: int, tmp_path: Path
) -> None:
    """In pixels of the files, through the lens, wherever the origin is; in small files less is too much."""
    found = found_in(write_model(tmp_path, **given))["keypoints"]
    assert (found.level, len(found.numbers["views"])) == (result, views)
    assert found.numbers["median"] == pytest.approx(median, abs=0.01)


def test_contradictory_cameras_need_force(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data, said = write_model(tmp_path / "data", turn=lambda i: 0.35 * (i % 2)), list[str]()
    command = train_command(data, tmp_path / "run", write_method(tmp_path))
    refused(command, "sparse/0/images.txt: keypoints: ", "another model's images file", "--force")
    assert not (tmp_path / "run").exists()
    heed([*found_in(data).values()], said.append, force=True)
    assert any("are off by up to" in line for line in said)
    monkeypatch.setattr("mi_refgs.data.checks.heed", lambda found, warn, force: refuse(f"forced: {force}"))
    refused([*command, "--force"], "forced: True")
    behind = found_in(write_model(tmp_path / "behind", mirror=-1))["points"]
    assert (behind.level, behind.numbers["share"]) == ("refused", 0.0)


@pytest.mark.parametrize(("inside", "level"), [(0, "fine"), (1, "said"), (7, "said"), (8, "refused")])
def test_cameras_are_outside_of_the_region(inside: int, level: str, tmp_path: Path) -> None:
    data = read_dataset(write_model(tmp_path), "train")
    heights = np.sort([view.to_world[:3, 3] @ np.array([0.8, 0.0, 0.6]) for view in data.views])[::-1]
    plane = (0.8, 0.0, 0.6, float(heights[inside] + 1e-6))  # above it are so many of 14 cameras
    region = Region((0.0, 0.0, 0.0), 9.0, (plane,))
    found = {one.name: one for one in examine(replace(data, region=region))}["region"]
    assert (found.level, found.numbers["count"], len(found.numbers["views"])) == (level, inside, inside)


def over_white(image: np.ndarray) -> np.ndarray:
    return image[..., 3:] * image[..., :3] + 1 - image[..., 3:]


ODD: dict[str, tuple[Callable[[np.ndarray], np.ndarray], int]] = {
    "blur": (lambda image: gaussian_filter(image, (1.5, 1.5, 0)), 12),
    "exposure": (lambda image: image * [0.5, 0.5, 0.5, 1], 2),
    "frusta": (lambda image: image * [1, 1, 1, 0], 12),
    "background": (over_white, 1),
    "shape": (lambda image: image, 1),
    "": (lambda image: image, 1),
}
"""Check → a change of every so many images of which it says something, and nothing else."""


@pytest.mark.parametrize("name", ODD)
def test_odd_images_are_said(name: str, tmp_path: Path) -> None:
    data, (change, every) = write_data(tmp_path / "ball", views=24, truth=False), ODD[name]
    for path in sorted(data.glob("train/r_*.png"))[::every]:
        write_png(path, change(read_png(path)))
    if name == "shape":
        change_transforms(data, lambda made: made["frames"][4].update(fl_y=30.0), "train")
    assert [one.name for one in found_in(data).values() if one.level != "fine"] == [name][: len(name)]


def test_constant_background_becomes_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The masks are those that the images had as alpha, less a pixel; a second time they are not replaced."""
    data = write_data(tmp_path / "ball", views=9, truth=False)
    before = [view.load().alpha for view in read_dataset(data, "train").views]
    for path in data.glob("*/*.png"):
        write_png(path, over_white(read_png(path)))
    assert main(["doctor", str(data), "--masks", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["with alpha"] == 11
    for view, alpha in zip(read_dataset(data, "train").views, before, strict=True):
        mask = view.load().alpha
        assert (mask <= alpha).all() and mask.sum() > 0.6 * alpha.sum()  # type: ignore[union-attr, operator]
    refused(["doctor", data, "--masks"], "--masks")
    known, file = digests(read_dataset(data, "train")), next(data.glob("masks/train/*.png"))
    file.write_bytes(file.read_bytes()[:-1] + b"\0")  # as long as before
    assert len(changed(read_dataset(data, "train"), known)) == 1


def test_digests_do_not_depend_on_the_origin(tmp_path: Path) -> None:
    """Nor on the last bits of positions, which end with a 5 after the digits that are compared."""
    data = read_dataset(write_data(tmp_path, views=12, truth=False), "train")
    for view in data.views:
        view.to_world[:3, 3] = np.floor(1e3 * view.to_world[:3, 3]) / 1e3 + 5e-6
    assert not changed(data.relative_to([1e3, -5, 0.1]), digests(data))


def test_masks_are_written_where_they_are_read(tmp_path: Path) -> None:
    """Beside the images, of which COLMAP's may lie deeper in the data set."""
    write_colmap(tmp_path / "dense/0", place="sparse")
    for path in tmp_path.glob("dense/0/images/*"):
        image = np.ones((*np.asarray(Image.open(path)).shape[:2], 3))
        image[4:8, 4:8] = (0.2, 0.4, 0.1)
        write_png(path, image)
    write_masks(tmp_path)
    assert all(view.has_alpha for view in read_dataset(tmp_path, "train").views)
    assert (tmp_path / "dense/0/masks/a.png.png").is_file()  # not that of a.jpg
