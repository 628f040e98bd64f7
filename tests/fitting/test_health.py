"""Steps whose loss or gradient is not finite: not applied, culprits named and removed, or one sentence."""

import json
from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import LOSSES, Loss, register_loss
from mi_refgs.methods.method import LossWeight, Method
from mi_refgs.surfels.primitives.surfel import Surfel
from tests.helpers import refused
from tests.scenes.highlight import ball, run_folder, set_rows, small_method, without


@pytest.fixture
def method(tmp_path: Path) -> Method:
    return small_method(tmp_path)


def spoil_gradient(trainer: Trainer, name: str, rows: list[int], views: set[int]) -> None:
    """Give `rows` of a tensor a NaN gradient whenever one of the views is shown."""
    optimiser = trainer.fit.optimiser
    original = optimiser.step

    def step(iteration: int, loss: object = None) -> None:
        if trainer.setup.view(iteration + 1) in views:
            gradient = np.array(dr.grad(optimiser.params[name]).numpy())
            gradient[[row for row in rows if row < len(gradient)], 0] = np.nan
            dr.set_grad(optimiser.params[name], mi.TensorXf(gradient))
        original(iteration, loss)

    optimiser.step = step  # type: ignore[method-assign]


def test_surfels_with_bad_gradients_are_removed_and_named(method: Method, tmp_path: Path) -> None:
    """Steps on view 2 fail until the next check, every third iteration; then the culprits are gone."""
    still = replace(without(method), iterations=9)
    run = run_folder(tmp_path / "run", still)
    said: list[str] = []
    trainer = Trainer(still, ball(), run, warn=said.append)
    own = trainer.fit.optimiser.step
    spoil_gradient(trainer, "albedo", [17, 52], {2})
    before = trainer.surfels.to_numpy()["albedo"]
    failed = [i for i in range(1, 10) if trainer.setup.view(i) == 2]

    def look(state: Trainer) -> None:
        if state.iteration == failed[0]:
            # Nothing of the step has been applied.
            assert all(np.all(np.isfinite(tensor.numpy())) for tensor in state.fit.params.values())
            trainer.fit.optimiser.step = own  # type: ignore[method-assign]

    trainer.train(look)
    assert trainer.health.skipped == 1 and trainer.surfels.count == len(before) - 2
    assert said == [f"iteration {failed[0]}, view 2: albedo not finite at surfels 17, 52: 2 were removed"]
    assert len(trainer.fit.tables[0].error_sum) == trainer.surfels.count
    assert json.loads((run.path / "metrics.jsonl").read_text().splitlines()[-1])["skipped_steps"] == 1


@pytest.mark.parametrize("name", ["position", "roughness", "indirect_sh"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_surfels_are_removed_and_the_fit_goes_on(name: str, value: float, method: Method) -> None:
    said: list[str] = []
    trainer = Trainer(replace(method, iterations=12), ball(), warn=said.append)
    assert trainer.statistics()["loss"] is None  # before the first step
    trainer.step()
    set_rows(trainer.fit.tables[0], name, ([3, 9], 0), value)
    trainer.train()
    assert "2 were removed" in said[0] and f"{name} not finite at surfels 3, 9" in said[0]
    assert trainer.iteration == 12 and np.isfinite(trainer.statistics()["loss"])
    for found in trainer.fit.arrays().values():
        assert np.all(np.isfinite(found))


def test_fit_in_which_every_step_fails_ends_with_one_sentence(method: Method, tmp_path: Path) -> None:
    """Too many surfels to be the cause: nothing is removed, nothing changes, and the view is named."""
    trainer = Trainer(without(method), ball(), run_folder(tmp_path / "run", method))
    spoil_gradient(trainer, "scale", list(range(1000)), set(range(6)))
    before = trainer.surfels.to_numpy()
    with pytest.raises(InputError, match=r"view \d: scale not finite; .*look at that image"):
        trainer.train()
    assert trainer.iteration == 3 * method.log_every
    after = trainer.surfels.to_numpy()
    for name in Surfel.widths:  # materials begin anew in iteration 9, with the deferred stage
        np.testing.assert_array_equal(after[name], before[name])


@pytest.mark.parametrize(("iterations", "start"), [(2, 0), (6, 3)])
def test_fit_whose_last_steps_fail_names_the_loss(iterations: int, start: int, method: Method) -> None:
    register_loss(Loss("nan", lambda inputs: dr.mean(inputs.frame.alpha) * np.nan))
    weights = method.loss | {"nan": LossWeight(0.1, start=start)}
    try:
        trainer = Trainer(replace(without(method), iterations=iterations, loss=weights), ball())
        refused(trainer.train, "loss 'nan' not finite; ", f"nothing was learnt in {iterations - start} it")
    finally:
        LOSSES.unregister("nan")


def test_light_that_is_not_finite_ends_fit_with_one_sentence(method: Method, tmp_path: Path) -> None:
    run = run_folder(tmp_path / "run", method)
    trainer = Trainer(method, ball(), run)
    light = np.array(trainer.fit.params["light"].numpy())
    light[3, 4, 1] = np.nan
    trainer.fit.params["light"] = mi.TensorXf(light)
    refused(trainer.train, "light: a texel is not finite or too large; ")
    assert not run.checkpoints()
