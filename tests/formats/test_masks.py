"""Masks of an object: the data set that gets them has its alpha, whatever its lens and layout."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.lens import Lens
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.editing.selection import selected_alpha
from mi_refgs.formats import Shot, write
from mi_refgs.io.images import read_mask, write_png
from mi_refgs.methods.read import load
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.reference.camera import look_at
from mi_refgs.runs.trained_scene import TrainedScene
from tests.helpers import refused
from tests.scenes.known import known_scene, with_background
from tests.scenes.tiny import train_command, write_method, write_open_data

WIDTH, HEIGHT, FOCAL = 91, 66, 80.0


@pytest.fixture(scope="module")
def photographed() -> TrainedScene:
    """The ball of metal as the object, the other as its background."""
    mi.set_variant("llvm_ad_rgb")
    return with_background(known_scene(), 0.2)


def write_photographs(folder: Path, **lens: Any) -> Path:
    """Ten views of the balls' place, in a subfolder of `images`, as transforms.json."""
    frames = []
    for i in range(10):
        angle = 0.6 * i
        pose = look_at(3 * np.array([np.cos(angle), np.sin(angle), 0.3]), np.zeros(3)) @ MITSUBA_FROM_OPENGL
        name = f"images/roll/a{i}.png"
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(folder / name, np.full((HEIGHT, WIDTH, 3), 0.1 * i))
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    content = {"fl_x": FOCAL, "cx": 40.0, "cy": 35.0, **lens, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def shots_of(data: Path, downscale: int = 1) -> list[Shot]:
    source = Provenance(load("photographs", "quick", [f"data.downscale={downscale}"]), data)
    return source.shots(known_scene(), "test", "train")


def shown(trained: TrainedScene, data: Path, split: str, downscale: int = 1) -> list[np.ndarray]:
    """Opacity of the object in the views of a split, and the alpha that is read, (2, H, W)."""
    found = []
    for view in read_dataset(data, split, downscale=downscale).views:
        alpha = view.load().alpha
        assert alpha is not None
        every = np.ones(trained.surfels.count, bool)
        own = np.array(selected_alpha(trained, every, view.camera())).reshape(alpha.shape)
        found.append(np.stack([own, alpha]))
    return found


@pytest.mark.parametrize("split", ["train", "test"])
def test_the_data_set_reads_the_masks_as_alpha(
    split: str, photographed: TrainedScene, tmp_path: Path
) -> None:
    data = write_photographs(tmp_path / "data")
    files = write(photographed, ["masks"], data, shots_of(data))["masks"]
    assert len(files) == 10 and data / "masks/roll/a3.png.png" in files
    assert {*np.unique(read_mask(files[0]))} == {0.0, 1.0}
    for own, alpha in shown(photographed, data, split):
        assert 100 < alpha.sum() < 0.5 * alpha.size
        np.testing.assert_array_equal(alpha, own >= 0.5)


@pytest.mark.parametrize(
    "lens",
    [
        {"k1": -0.25, "k2": 0.03, "p1": 0.004, "p2": -0.006},
        {"camera_model": "OPENCV_FISHEYE", "k1": 0.02, "k2": -0.01},
    ],
)
def test_masks_have_the_lens_of_their_images(
    lens: dict[str, Any], photographed: TrainedScene, tmp_path: Path
) -> None:
    """The reader undistorts them: half of a pixel of difference at the outline, as of any 8-bit mask."""
    data = write_photographs(tmp_path / "data", **lens)
    write(photographed, ["masks"], data, shots_of(data))
    for own, alpha in shown(photographed, data, "train"):
        assert abs(alpha - own).mean() < 0.01
        assert np.percentile(abs(alpha - own)[abs(own - 0.5) > 0.49], 99.5) < 0.2


def test_masks_have_the_size_of_the_file_where_images_were_downscaled(
    photographed: TrainedScene, tmp_path: Path
) -> None:
    """The last column of the file fills no block of two."""
    data = write_photographs(tmp_path / "data")
    alone = replace(photographed, surroundings=None)
    files = write(alone, ["masks"], data, shots_of(data, 2), {"where": "opacity > 0"})["masks"]
    assert read_mask(files[0]).shape == (HEIGHT, WIDTH)
    ours, read = (np.stack(x) > 0.5 for x in zip(*shown(alone, data, "train"), strict=True))
    assert (ours & read).sum() > 0.85 * (ours | read).sum()  # footprints of larger pixels are wider
    for one, two in zip(ours, read, strict=True):
        assert np.abs(np.argwhere(one).mean(axis=0) - np.argwhere(two).mean(axis=0)).max() < 0.15


def test_a_lens_is_undone(rng: np.random.Generator) -> None:
    x, y = rng.uniform(-1.2, 1.2, (2, 200))
    for lens in (Lens(False, (-0.1, 0.02, -0.001), (0.002, -0.003)), Lens(True, (0.03, -0.01, 0.0, 0.0))):
        np.testing.assert_allclose(lens.undistort(*lens.distort(x, y)), (x, y), atol=1e-6)


def test_a_selection_is_masked_and_what_cannot_be_is_refused(
    photographed: TrainedScene, tmp_path: Path
) -> None:
    data, run = write_photographs(tmp_path / "data"), tmp_path / "run"
    half = photographed.surfels.to_numpy()["position"][:, 2] > 0
    shots = shots_of(data)
    some = write(photographed, ["masks"], tmp_path / "some", shots, {"where": "z > 0"}, run)["masks"]
    same = write(photographed, ["masks"], tmp_path / "same", shots, {"where": half}, run)["masks"]
    whole = write(photographed, ["masks"], tmp_path / "whole", shots, {}, run)["masks"]
    for one, two, all_ in zip(some, same, whole, strict=True):
        np.testing.assert_array_equal(read_mask(one), read_mask(two))
        assert (read_mask(one) <= read_mask(all_)).all()
    assert 0.5 < sum(read_mask(x).sum() for x in some) / sum(read_mask(x).sum() for x in whole) < 0.9

    def masks(scene: TrainedScene, shots: list[Shot], **options: Any) -> Any:
        return lambda: write(scene, ["masks"], tmp_path / "none", shots, options)

    refused(masks(replace(photographed, surroundings=None), shots), "no background", "--where")
    refused(masks(photographed, [replace(shots[0], file=None)]), "--data")
    away = replace(
        shots[0], camera=shots[0].camera.moved(look_at(np.array([3.0, 0, 0]), np.array([9.0, 0, 0])))
    )
    refused(masks(photographed, [away]), "no image shows the selected surfels")
    assert not (tmp_path / "none").exists() or not [*(tmp_path / "none").rglob("*.png")]


def test_a_fit_reads_exported_masks(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Photographs with masks show an object only: no background is fitted to them."""
    data, method = write_open_data(tmp_path / "data"), write_method(tmp_path)
    before, after = tmp_path / "before", tmp_path / "after"
    assert main(train_command(data, before, method)) == 0
    assert "images without alpha" in capsys.readouterr().err
    assert main(["export", str(before), "--to", "masks", "-o", str(data), "--where", "opacity > 0"]) == 0
    assert (data / "masks/train/r_0.png.png").is_file() and (data / "masks/test/r_1.png.png").is_file()
    assert read_dataset(data, "train").has_alpha
    assert main(train_command(data, after, method)) == 0
    assert "images without alpha" not in capsys.readouterr().err
