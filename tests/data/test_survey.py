"""`refgs doctor FOLDER`, and data sets that are unusual: one place, one view, images of several sizes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.survey import survey
from mi_refgs.io.images import read_png, write_png
from tests.helpers import refused
from tests.scenes.layouts import change_transforms, write_colmap
from tests.scenes.tiny import train_command, write_data, write_method

FEW = "only 5 training views; others may look wrong"


def said(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    assert main(["doctor", *arguments]) == 0
    return capsys.readouterr().out


def test_survey_of_complete_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "ball", views=5)
    found = survey(data)
    assert found["layout"] == "Blender, NeRF, nerfstudio"
    assert (found["training views"], found["test views"], found["with alpha"]) == (5, 2, 7)
    assert (found["size"], found["sizes"], found["points"], found["region"]) == ([20, 20], 1, 0, None)
    assert found["environment map"] and FEW in found["notes"]
    text = said(capsys, str(data))
    assert "test views      2\n" in text and f"NOTE: {FEW}" in text
    assert json.loads(said(capsys, str(data), "--json")) == found


def test_survey_reports_missing_images(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    refused(["doctor", tmp_path], "no layout is recognised", "transforms_train.json")
    data = write_colmap(tmp_path)
    (data / "images/c.png").unlink()
    found = survey(data)
    assert (found["layout"], found["training views"], found["points"]) == ("COLMAP", 7, 9)
    assert not found["with alpha"] and found["region"] is not None
    assert "1 of 9 cameras have no image" in (text := said(capsys, str(data))) and "NOTE: no alpha" in text


@pytest.mark.parametrize("count", [1, 3])
def test_cameras_in_one_place(count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Named before anything is computed, with the exit code of bad input."""
    words = "in one place show no shape"
    data = write_data(tmp_path / "ball", views=count, truth=False)
    same = {"transform_matrix": np.eye(4).tolist()}
    change_transforms(data, lambda made: [frame.update(same) for frame in made["frames"]], "train")
    assert main(["doctor", str(data)]) == 2 and words in capsys.readouterr().out
    command = train_command(data, tmp_path / "run", write_method(tmp_path))
    refused(command, f"{data}/transforms_train.json: cameras: ", words)
    assert not (tmp_path / "run").exists()


def test_images_of_two_sizes_are_fitted(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = write_data(tmp_path / "ball", views=6)

    def cut(content: dict[str, Any]) -> None:
        """Cut off a strip at the right of every other image."""
        del content["w"], content["h"]
        for frame in content["frames"][::2]:
            path = data / f"{frame['file_path']}.png"
            write_png(path, read_png(path)[:, :16])
            frame["cx"] = 10.0
            del frame["normal_path"]

    change_transforms(data, cut)
    assert survey(data)["sizes"] == read_dataset(data, "train", pixels=360).downscale == 2
    run = tmp_path / "run"
    assert main(train_command(data, run, write_method(tmp_path))) == main(["eval", str(run)]) == 0
