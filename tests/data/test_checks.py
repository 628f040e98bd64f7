"""Checks before a fit: cameras against points, and images against those of neighbouring cameras."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from mi_refgs.cli import main
from mi_refgs.data.checks import Finding, examine, heed
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.lens import Lens
from mi_refgs.io.images import read_png, write_png
from tests.helpers import refused
from tests.scenes.layouts import change_transforms
from tests.scenes.tiny import train_command, write_data, write_method

VIEWS, SIZE, FOCAL = 16, np.array([480, 360]), 450.0
FEW = "views"  # is said of these sets, too


def write_model(
    folder: Path,
    shift: Callable[[int], float] = lambda i: 0.0,  # pixels, of the keypoints of a camera
    turn: Callable[[int], float] = lambda i: 0.0,  # radians, of a camera about the scene
    copies: int = 1,  # times that images are smaller than what was reconstructed
    lens: Lens | None = None,
    origin: float = 0.0,
    mirror: int = 1,
) -> Path:
    """A COLMAP model of cameras around points with exact keypoints, but for what is given."""
    points, images = np.random.default_rng(3).uniform(-0.6, 0.6, (60, 3)), list[str]()
    for i in range(VIEWS):
        rotation = Rotation.from_euler("yx", [2 * np.pi * i / VIEWS, 0.3]).as_matrix().T
        x, y, z = rotation @ points.T + [[0], [0], [4]]
        x, y = (x / z, y / z) if lens is None else lens.distort(x / z, y / z)
        u, v = FOCAL * np.stack([x, y]) + SIZE[:, None] / 2 + [[shift(i)], [0]]
        rotation = Rotation.from_euler("y", turn(i)).as_matrix() @ rotation
        qx, qy, qz, qw = Rotation.from_matrix(rotation).as_quat()
        tx, ty, tz = [0, 0, 4 * mirror] - rotation @ np.full(3, origin)
        images.append(f"{i + 1} {qw} {qx} {qy} {qz} {tx} {ty} {tz} 1 {i:02d}.png")
        images.append(" ".join(f"{a} {b} {k + 1} 0 0 -1" for k, (a, b) in enumerate(zip(u, v, strict=True))))
        write_png(folder / f"images/{i:02d}.png", np.full((*(SIZE[::-1] // copies), 3), 0.2 + 0.1 * (i % 2)))
    k1, k2, p1, p2 = (0, 0, 0, 0) if lens is None else (*lens.radial[:2], *lens.tangential)
    places = (f"{k + 1} {' '.join(map(str, p + origin))} 9 9 9 0.5" for k, p in enumerate(points))
    (folder / "sparse/0").mkdir(parents=True)
    for name, lines in (
        (
            "cameras",
            [f"1 OPENCV {SIZE[0]} {SIZE[1]} {FOCAL} {FOCAL} {SIZE[0] / 2} {SIZE[1] / 2} {k1} {k2} {p1} {p2}"],
        ),
        ("images", images),
        ("points3D", places),
    ):
        (folder / f"sparse/0/{name}.txt").write_text("\n".join(lines) + "\n")
    return folder


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


def test_contradictory_cameras_are_refused_unless_forced(tmp_path: Path) -> None:
    data = write_model(tmp_path / "data", turn=lambda i: 0.35 * (i % 2))
    command = train_command(data, tmp_path / "run", write_method(tmp_path))
    refused(command, "sparse/0/images.txt: keypoints: ", "another model's images file", "--force")
    assert not (tmp_path / "run").exists()
    said: list[str] = []
    heed([*found_in(data).values()], said.append, force=True)
    assert any("are off by up to" in line for line in said)
    behind = found_in(write_model(tmp_path / "behind", mirror=-1))["points"]
    assert (behind.level, behind.numbers["share"]) == ("refused", 0.0)


def change_images(change: Callable[[np.ndarray], np.ndarray], every: int) -> Callable[[Path], None]:
    def changed(data: Path) -> None:
        for path in sorted(data.glob("train/r_*.png"))[::every]:
            write_png(path, change(read_png(path)))

    return changed


def change_frames(**content: Any) -> Callable[[Path], None]:
    return lambda data: change_transforms(data, lambda made: made["frames"][4].update(content), "train")


ODD: dict[str, Callable[[Path], None]] = {
    "blur": change_images(lambda image: gaussian_filter(image, (1.5, 1.5, 0)), 12),
    "exposure": change_images(lambda image: image * [0.5, 0.5, 0.5, 1], 2),
    "frusta": change_images(lambda image: image * [1, 1, 1, 0], 12),
    "background": change_images(lambda image: image[..., 3:] * image[..., :3] + 1 - image[..., 3:], 1),
    "shape": change_frames(fl_y=30.0),
}


@pytest.mark.parametrize("name", ["", *ODD])
def test_odd_images_are_said(name: str, tmp_path: Path) -> None:
    """One line, of the right check; nothing of the set as it is."""
    data = write_data(tmp_path / "ball", views=24, truth=False)
    ODD.get(name, lambda _: None)(data)
    assert [one.name for one in found_in(data).values() if one.level != "fine"] == [name][: len(name)]


def test_constant_background_becomes_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The masks are those that the images had as alpha, less a pixel; a second time they are not replaced."""
    data = write_data(tmp_path / "ball", views=9, truth=False)
    before = [view.load().alpha for view in read_dataset(data, "train").views]
    ODD["background"](data)
    for path in data.glob("test/*.png"):
        write_png(path, read_png(path)[..., :3] * read_png(path)[..., 3:] + 1 - read_png(path)[..., 3:])
    assert main(["doctor", str(data), "--masks", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["masks written"] == 11
    for view, alpha in zip(read_dataset(data, "train").views, before, strict=True):
        mask = view.load().alpha
        assert (
            mask is not None
            and alpha is not None
            and (mask <= alpha).all()
            and mask.sum() > 0.6 * alpha.sum()
        )
    refused(["doctor", data, "--masks"], "--masks")
    refused(["doctor", "--masks"], "no data set is given")
