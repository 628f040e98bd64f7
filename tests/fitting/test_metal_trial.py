"""The choice between metal and dielectric at the start of a fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.errors import InputError
from mi_refgs.fitting import metal_trial
from mi_refgs.fitting.runner import begin
from mi_refgs.fitting.train import Trainer
from mi_refgs.runs.run import Run
from mi_refgs.surfels.attributes import sigmoid
from tests.scenes.tiny import SETTINGS, write_data, write_method

TRIAL = "metal_trial.until=4"


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = write_data(tmp_path_factory.mktemp("metal_trial") / "ball", views=6, truth=False)
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


@pytest.mark.parametrize("better", ["dielectric", "metal"])
def test_the_gain_of_metal_decides(
    better: str, views: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Metal has to gain enough; metallic is held during the trial and learns afterwards."""
    held = metal_trial.METAL if better == "metal" else metal_trial.DIELECTRIC
    ends: list[np.ndarray] = []
    begun = metal_trial._begun

    def scored(trainer: Trainer, value: float, steps: int) -> tuple[float, Trainer]:
        _, end = begun(trainer, value, steps)
        ends.append(metallic(end))
        assert end.iteration == steps == 4
        gain = metal_trial.METAL_GAIN * (1.01 if better == "metal" else 0.99)
        return 20.0 + gain * (value == metal_trial.METAL), end

    monkeypatch.setattr(metal_trial, "_begun", scored)
    trainer, said = fitted(views, tmp_path, TRIAL)
    np.testing.assert_allclose(ends[0], metal_trial.DIELECTRIC, atol=1e-6)
    np.testing.assert_allclose(ends[1], metal_trial.METAL, atol=1e-6)
    assert f"metallic starts as {better}: " in " ".join(said)
    (row,) = trainer.fit.decisions
    assert row["component"] == "metal" and row["stays"] == (better == "metal") and "as metal" in row["reason"]
    assert trainer.method.components == ()
    found = metallic(trainer)
    assert trainer.iteration == 6 and np.abs(found - held).max() > 1e-4 and np.abs(found - held).mean() < 0.1


def test_images_of_a_fit_decide(views: Dataset, tmp_path: Path, one_thread: None) -> None:
    """The fit ends where one with that metallic and the same seed does."""
    trainer, said = fitted(views, tmp_path, TRIAL, "iterations=4")
    sentence = next(one for one in said if "metallic starts" in one)
    metal, dielectric = (float(part.split(" dB")[0].split()[-1]) for part in sentence.split(","))
    value = metal_trial.METAL if metal >= dielectric + metal_trial.METAL_GAIN else metal_trial.DIELECTRIC
    again, _ = fitted(
        views,
        tmp_path / "again",
        "iterations=4",
        f"surfels.initial={{metallic={value}}}",
        "rates.attribute={metallic=0}",
    )
    assert trainer.iteration == again.iteration == 4
    for name, raw in trainer.surfels.raw.items():
        np.testing.assert_array_equal(raw.numpy(), again.surfels.raw[name].numpy(), name)


def test_a_resumed_fit_is_not_tried_again(views: Dataset, tmp_path: Path) -> None:
    trainer, _ = fitted(views, tmp_path, TRIAL)
    said: list[str] = []
    again = begin(trainer.method, views, Run(tmp_path / "run"), said.append)
    again.train()
    assert again.iteration == 6 and not any("metallic" in one for one in said)
    np.testing.assert_array_equal(metallic(again), metallic(trainer))


def test_what_cannot_be_tried_is_refused() -> None:
    with pytest.raises(InputError, match=r"metal_trial\.until: 0 is out of range; give 1 or more"):
        methods.load("relighting", "quick", ["metal_trial.until=0"])
    with pytest.raises(InputError, match="metal_trial: there is no attribute 'metallic'"):
        methods.load("base_2dgs", "quick", [TRIAL])
