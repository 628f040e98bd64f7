"""Photographs of an object that turns: the background that stays is said, a plain one cut off."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs import EnvironmentLight, load
from mi_refgs.cli import main
from mi_refgs.data.checks import FINE, SAID, examine
from mi_refgs.data.dataset import read_dataset
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.fitting.image_error import displayed_image
from mi_refgs.io.images import read_png, write_png
from tests.helpers import read_loaded, refused
from tests.scenes.tiny import SIZE, train_command, write_data, write_method, write_open_data

Y, X = np.mgrid[-1 : 1 : SIZE * 1j, -1 : 1 : SIZE * 1j]
BACKDROPS = {
    "plain": np.stack([0.3 + 0.1 * X, 0.2 + 0.1 * Y**2, 0.2 + 0.05 * X * Y], axis=-1),
    "white": np.ones((SIZE, SIZE, 3)),
    "room": np.random.default_rng(1).uniform(0.2, 0.8, (SIZE, SIZE, 3)),
}
LEVEL = {True: SAID, False: FINE, None: None}


def write_turntable(folder: Path, backdrop: np.ndarray, masks: bool = False) -> Path:
    """The ball of `write_data` before a backdrop that stays, without alpha, or with files of masks."""
    for path in write_data(folder, truth=False).glob("*/r_*.png"):
        rgba = read_png(path)
        write_png(path, rgba[..., 3:] * rgba[..., :3] + (1 - rgba[..., 3:]) * backdrop)
        if masks:
            (folder / "masks" / path.parent.name).mkdir(parents=True, exist_ok=True)
            write_png(folder / "masks" / path.parent.name / path.name, rgba[..., 3])
    return folder


@pytest.mark.parametrize(
    ("backdrop", "masks", "plain", "stays"),
    [("plain", 0, True, True), ("room", 0, False, True), ("white", 0, True, False), ("room", 1, None, True)],
)
def test_messages_on_backgrounds(backdrop: str, masks: int, plain: Any, stays: bool, tmp_path: Path) -> None:
    data = write_turntable(tmp_path / "turn", BACKDROPS[backdrop], bool(masks))
    found = {one.name: one.level for one in examine(read_dataset(data, "train"))}
    assert (found.get("background"), found["turntable"]) == (LEVEL[plain], LEVEL[stays])
    moving = examine(read_dataset(write_open_data(tmp_path / "open"), "train"))
    assert {one.name: one.level for one in moving}["turntable"] == FINE
    one = read_dataset(data, "train").held_out(3)[1]  # view, of a camera that has not turned
    assert "turntable" not in {found.name for found in examine(one)}


def test_fits_of_a_turntable(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The ball is cut out before a plain backdrop, and evaluated under the light that turns."""
    data, run = write_turntable(tmp_path / "turn", BACKDROPS["plain"]), tmp_path / "run"
    command = [*train_command(data, run, write_method(tmp_path)), "--turntable"]
    refused(command, "--turntable: images without alpha", "refgs doctor DATA --masks")
    assert main(["doctor", str(data), "--masks"]) == 0
    test, ball = (read_loaded(x, "test") for x in (data, write_data(tmp_path / "ball")))
    view, alpha = test.views[0], ball.views[0].alpha
    assert np.all((view.alpha == 0) | (alpha == 1)) and np.mean(view.alpha != alpha) < 0.15
    capsys.readouterr()
    assert main(command) == 0
    assert "light of view 'train/r_0'" in (said := capsys.readouterr().err) and "stays" not in said
    EnvironmentLight.from_radiance(np.linspace(0.1, 2, 384).reshape(8, 16, 3)).write(run / "envmap.exr")
    assert main(["eval", str(run)]) == 0
    scene, image = load(run).trained, read_png(run / render_names(test.views)[0])
    frames = [scene.renderer(turning=turning)(view.camera()) for turning in (True, False)]
    error = [np.abs(displayed_image(frame, view, test) - image).max() for frame in frames]
    assert error[0] < 3e-3 and error[1] > 0.02
