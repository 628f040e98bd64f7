"""`refgs doctor FOLDER`, and data sets that are unusual: one place, one view, images of several sizes."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.data.dataset import MAX_SIZES, read_dataset
from mi_refgs.data.survey import Survey, survey
from mi_refgs.io.images import box_downscale, read_png, write_png
from tests.helpers import refused
from tests.scenes.dots import Shot
from tests.scenes.layouts import SHOTS, change_transforms, write_colmap
from tests.scenes.tiny import DISTANCE, train_command, write_data, write_method


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["doctor", *arguments]) == 0
    return capsys.readouterr().out


def test_survey_of_complete_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "ball", views=5)
    found = survey(data)
    assert (found.layout, found.views) == ("Blender, NeRF, nerfstudio", {"train": 5, "test": 2})
    assert found.size == (20, 20) and found.sizes == 1 and found.alpha == "all"
    assert found.camera_distance == pytest.approx((DISTANCE, DISTANCE))
    assert found.centre == pytest.approx((0, 0, 0), abs=1e-9)
    assert found.truth == ("normal",) and found.environment and not found.points and found.region is None
    assert found.missing == ("only 5 training views; other views may look wrong",)
    text = said(capsys, str(data))
    for part in ("5 train, 2 test", "20 × 20", "ground truth normal", "NOTE: only 5 training views"):
        assert part in text
    printed = json.loads(said(capsys, str(data), "--json"))
    assert printed == json.loads(json.dumps(found.to_dict()))
    assert {*printed} == {field.name for field in dataclasses.fields(Survey)}


def test_survey_reports_the_lens_of_the_file(tmp_path: Path) -> None:
    """Also if the images that it reads, downscaled by whole factors, leave out pixels at the border."""
    data = write_data(tmp_path / "ball", truth=False)
    width, height, focal = 127, 100, 150.0
    camera = {"fl_x": focal, "fl_y": focal, "w": width, "h": height}
    change_transforms(data, lambda content: content.update(camera))
    for path in data.glob("t*/*.png"):
        write_png(path, np.full((height, width, 4), 0.5))
    angle = np.degrees(2 * np.arctan(width / (2 * focal)))
    assert survey(data).field_of_view == pytest.approx((angle, angle))


def test_survey_reports_missing_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_colmap(tmp_path)
    (data / "images/c.png").unlink()
    found = survey(data)
    assert (found.layout, found.views, found.points) == ("COLMAP", {"train": 7, "test": 1}, 9)
    assert found.alpha == "none" and found.region is not None
    text = said(capsys, str(data))
    assert "1 of 9 cameras have no image" in text and "NOTE: no alpha" in text and "COLMAP" in text


def test_survey_refuses_other_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for folder, words in ((tmp_path / "no", "no such folder"), (tmp_path, "no layout is recognised")):
        assert main(["doctor", str(folder)]) == 2
        assert words in capsys.readouterr().err


@pytest.mark.parametrize(
    ("count", "words"), [(1, "a single training view shows no shape"), (3, "in one place show no shape")]
)
def test_cameras_in_one_place_are_refused(
    count: int, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Named before anything is computed, with the exit code of bad input."""
    data = write_data(tmp_path / "ball", views=count, truth=False)
    same = {"transform_matrix": np.eye(4).tolist()}
    change_transforms(data, lambda made: [frame.update(same) for frame in made["frames"]], "train")
    assert words in said(capsys, str(data))
    assert main(train_command(data, tmp_path / "run", write_method(tmp_path))) == 2
    error = capsys.readouterr().err
    assert f"{data}: cameras: " in error and words in error and not (tmp_path / "run").exists()


def test_images_of_two_sizes_are_fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "ball", views=6)

    def cut(content: dict[str, Any]) -> None:
        """Cut off a strip at the right of every other image."""
        del content["w"], content["h"]
        for frame in content["frames"][1::2]:
            path = data / f"{frame['file_path']}.png"
            write_png(path, read_png(path)[:, :16])
            frame["cx"] = 10.0
            del frame["normal_path"]

    change_transforms(data, cut)
    assert "20 × 20, of 2 sizes" in said(capsys, str(data))
    run = tmp_path / "run"
    assert main(train_command(data, run, write_method(tmp_path))) == 0
    assert main(["eval", str(run)]) == 0


def test_images_of_many_sizes_are_refused(tmp_path: Path) -> None:
    data = write_colmap(tmp_path, shots=[dataclasses.replace(shot, height=72) for shot in SHOTS])
    for i in range(MAX_SIZES + 1):
        shot: Shot = SHOTS[1 + i]
        image = box_downscale(read_png(data / "images" / shot.name), i + 1)
        write_png(data / "images" / shot.name, image)
    words = ("images: 5 different sizes, such as ", "bring all images to one")
    refused(lambda: read_dataset(data, "train"), *words)
