"""The choice between metal and dielectric at the start of a fit."""

from pathlib import Path

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.fitting.events import metal as event
from mi_refgs.fitting.runner import begin
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods.method import GAIN as GAIN_ROWS
from mi_refgs.runs.run import Run
from mi_refgs.splat import splat
from mi_refgs.surfels.attributes import sigmoid
from tests.scenes.tiny import SETTINGS, SIZE, write_data, write_method

TRIAL = "event.metal.trial=4"
VIEWS = 6
GAIN = event.METAL_GAIN * (event.MANY_VIEWS / VIEWS) ** 0.5


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = write_data(tmp_path_factory.mktemp("metal_trial") / "ball", views=VIEWS, truth=False)
    return read_dataset(folder, "train", truth=False)


def fitted(views: Dataset, folder: Path, *settings: str) -> tuple[Trainer, list[str]]:
    folder.mkdir(exist_ok=True)
    said: list[str] = []
    method = methods.load(str(write_method(folder)), "quick", [*SETTINGS, *settings])
    trainer = begin(method, views, Run(folder / "run"), said.append)
    trainer.train()
    return trainer, said


def metallic(trainer: Trainer) -> np.ndarray:
    return np.asarray(sigmoid(trainer.surfels.raw["metallic"].numpy()))


def judged(
    monkeypatch: pytest.MonkeyPatch, dielectric: np.ndarray | float, metal: np.ndarray | float
) -> list[tuple[int, np.ndarray]]:
    """Replace the errors of both trials, (H, W) each; returns iterations and metallic of those that ran."""
    judged, trials = list[Trainer](), list[tuple[int, np.ndarray]]()

    def error(trainer: Trainer, view: View) -> np.ndarray:
        if trainer not in judged:
            judged.append(trainer)
            trials.append((trainer.iteration, metallic(trainer)))
        return np.broadcast_to(metal if judged.index(trainer) else dielectric, (SIZE, SIZE))

    monkeypatch.setattr(event, "_squared_error", error)
    return trials


@pytest.mark.parametrize("better", ["dielectric", "metal"])
def test_gain_decides(better: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Metal has to gain enough; metallic is held during the trial and learns afterwards."""
    held = event.METAL if better == "metal" else event.DIELECTRIC
    gain = GAIN * (1.01 if better == "metal" else 0.99)
    trials = judged(monkeypatch, 0.01, 0.01 * 10 ** (-gain / 10))
    trainer, said = fitted(views, tmp_path, TRIAL)
    for (iteration, during), value in zip(trials, (event.DIELECTRIC, event.METAL), strict=True):
        assert iteration == 4
        np.testing.assert_allclose(during, value, atol=1e-6)
    assert f"continues as {better}: " in " ".join(said)
    (row,) = trainer.fit.decisions
    assert row["component"] == "metal" and row["stays"] == (better == "metal") and "as metal" in row["reason"]
    found = metallic(trainer)
    assert trainer.iteration == 6 and np.abs(found - held).max() > 1e-4 and np.abs(found - held).mean() < 0.1


@pytest.mark.parametrize("gains", [(2 * GAIN, -0.5 * GAIN), (1.8 * GAIN, 0.5 * GAIN)])
def test_each_region_has_its_start(
    gains: tuple[float, float], views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All images gain enough as metal in their upper half, so the upper half of the ball starts as metal."""
    judged(monkeypatch, 0.01, 0.01 * 10 ** (-np.where((np.arange(SIZE) < SIZE // 2)[:, None], *gains) / 10))
    trainer, said = fitted(views, tmp_path, TRIAL, "iterations=4")
    is_metal = metallic(trainer)[:, 0] > 0.5
    height = trainer.surfels.to_numpy()["position"][:, 2]
    upwards = views.views[0].to_world[2, 1]  # of the cameras' up axis, along z
    assert upwards > 0.5 and {*np.round(metallic(trainer).ravel(), 6)} == {0.1, 0.9}
    clear = np.abs(height) > 0.2
    assert clear.sum() > 20 and ((height > 0) == is_metal)[clear].mean() > 0.8
    assert f"{is_metal.mean():.0%} of the surfels start as metal" in " ".join(said)


def test_errors_are_attributed_by_blending_weights(views: Dataset, tmp_path: Path) -> None:
    """Errors of one give each surfel the sum of its weights; all of them together, the sum of alpha."""
    trainer, _ = fitted(views, tmp_path, TRIAL)
    surfels, view = trainer.surfels.detach(), views.views[0]
    error = np.random.default_rng(0).random((SIZE, SIZE))
    found = event._attributed(surfels, [view, view], [error, 2 * error])
    alpha = splat([surfels], [], view.camera()).alpha.numpy().reshape(SIZE, SIZE)
    assert found.shape == (surfels.count,) and found.min() >= 0
    np.testing.assert_allclose(found.sum(), 3 * (error * alpha).sum(), rtol=1e-4)


def test_a_choice_is_that_of_the_neighbourhood() -> None:
    """Two clusters of opposite values with noise: every point has the sign of its cluster."""
    rng = np.random.default_rng(1)
    positions = rng.normal(size=(8000, 3)) * 0.1 + np.repeat([[-1.0, 0, 0], [1, 0, 0]], 4000, axis=0)
    values = np.repeat([-0.3, 0.3], 4000) + rng.normal(size=8000)
    np.testing.assert_array_equal(event._sum_around(positions, values) > 0, np.repeat([False, True], 4000))
    np.testing.assert_allclose(event._sum_around(positions[:1], values[:1]), values[:1])


def test_images_of_a_fit_decide(
    views: Dataset, tmp_path: Path, one_thread: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The fit ends where one with that metallic and the same seed does, if its surfels choose together."""
    monkeypatch.setattr(event, "NEIGHBOURHOOD", 1.0)
    coarse = "data.coarse=[{until=6, block=2}]"
    trainer, said = fitted(views, tmp_path, TRIAL, "iterations=4", coarse)
    sentence = next(one for one in said if "continues as" in one)
    metal, dielectric = (float(part.split(" dB")[0].split()[-1]) for part in sentence.split(",")[:2])
    value = event.METAL if metal >= dielectric + GAIN else event.DIELECTRIC
    held = f"surfels.initial={{metallic={value}}}", "rates.attribute={metallic=0}"
    again, _ = fitted(views, tmp_path / "again", "iterations=4", coarse, *held)
    assert trainer.iteration == again.iteration == 4
    for name, raw in trainer.surfels.raw.items():
        np.testing.assert_array_equal(raw.numpy(), again.surfels.raw[name].numpy(), name)


def test_errors_are_those_of_images_with_gains(views: Dataset, tmp_path: Path) -> None:
    trainer = Trainer(methods.load(str(write_method(tmp_path)), "quick", SETTINGS), views)
    plain, log = event._squared_error(trainer, 1), np.zeros((VIEWS, 3), np.float32)
    log[1] = 1.0
    trainer.fit.params[GAIN_ROWS] = upload_tensor(log)
    other = event._squared_error(trainer, 1)
    assert plain.shape == other.shape and np.abs(plain - other).max() > 1e-3


def test_what_cannot_be_tried_is_refused() -> None:
    with pytest.raises(InputError, match=r"event\.metal\.trial: 0 is out of range; give 1 or more"):
        methods.load("relighting", "quick", ["event.metal.trial=0"])
    with pytest.raises(InputError, match=r"event\.metal: there is no attribute 'metallic'"):
        methods.load("base_2dgs", "quick", [TRIAL])
