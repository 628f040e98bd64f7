"""Resets of opacity and restarts of materials: what changes, and what must not."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.fitting.events.resets import OPACITY
from mi_refgs.fitting.train import Trainer
from mi_refgs.surfels.attributes import sigmoid
from tests.scenes.highlight import ball, set_rows, small_method, step_to


@pytest.fixture
def trainer(tmp_path: Path) -> Trainer:
    """After three steps, of which the last lets the light learn."""
    return step_to(Trainer(small_method(tmp_path), ball()), 3)


def moving(trainer: Trainer) -> set[str]:
    """The parameters with moments."""
    state = trainer.fit.arrays().items()
    return {name.split("/")[1] for name, value in state if name.endswith("/first") and np.any(value)}


def changed(trainer: Trainer, event: str, iteration: int) -> tuple[set[str], dict[str, np.ndarray]]:
    """The parameters that an event changes, which lose their moments, and all of them, activated."""
    before, had = {n: x.numpy().copy() for n, x in trainer.fit.params.items()}, moving(trainer)
    trainer.fit.iteration = iteration
    (one,) = (x for x in trainer.setup.events if x.name == event)
    assert one.due(trainer)
    one.apply(trainer)
    after = {name: tensor.numpy() for name, tensor in trainer.fit.params.items()}
    moved = {name for name in before if not np.array_equal(before[name], after[name])}
    assert had - moving(trainer) == moved
    return moved, {name: sigmoid(x) for name, x in after.items()}


def test_reset_lowers_opacity_and_lifts_metallic_only(trainer: Trainer) -> None:
    set_rows(trainer.fit.tables[0], "metallic", slice(40), -5)
    moved, found = changed(trainer, "reset_opacity", 14)
    assert moved == {"opacity", "metallic"}
    np.testing.assert_allclose(found["opacity"], OPACITY, rtol=1e-5)
    assert found["metallic"].min() == pytest.approx(0.3) and found["metallic"][:40].max() < 0.31


def test_restart_of_materials_leaves_geometry(trainer: Trainer) -> None:
    """After the last iteration of the stage before."""
    moved, found = changed(trainer, "restart", 8)
    assert moved == {"albedo", "metallic", "roughness", "light"}
    np.testing.assert_allclose(found["metallic"], 0.3, rtol=1e-5)
    np.testing.assert_allclose(found["roughness"], 0.3, rtol=1e-5)
    assert np.abs(found["albedo"] - 0.5).max() <= 0.025 + 1e-6
    ended = Trainer(replace(trainer.method, iterations=8), ball())  # no stage begins after it
    ended.fit.iteration = 8
    assert not any(event.due(ended) for event in ended.setup.events if event.name == "restart")
