"""The loop: it learns, resumes to the same bits, survives a kill, and compiles nothing new once warm."""

import os
import resource
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.fitting import train
from mi_refgs.fitting.events.densify import Densify
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import DataOptions, LossWeight, Method, Rates
from mi_refgs.runs.interrupt import TerminatedError, held_interrupts
from mi_refgs.runs.run import Run
from tests.scenes.highlight import SIZE, ball, require_same_state, run_folder, small_method, step_to, without


@pytest.fixture
def method(tmp_path: Path) -> Method:
    return small_method(tmp_path)


def test_loss_falls_and_everything_trains(method: Method) -> None:
    data = ball()
    trainer = Trainer(replace(without(method), data=DataOptions(), iterations=60), data)
    before = {name: tensor.numpy().copy() for name, tensor in trainer.fit.params.items()}
    losses = []
    while trainer.iteration < 60:
        trainer.step()
        losses.append(float(trainer.loss[0]))
    assert np.mean(losses[-6:]) < 0.8 * np.mean(losses[:6])
    assert trainer.fit.optimiser.report().count == 0
    for name, tensor in trainer.fit.params.items():  # indirect_sh starts at exactly 0 and must leave it
        assert np.all(np.isfinite(tensor.numpy())), name
        assert not np.array_equal(before[name], tensor.numpy()), name


def with_deferred(method: Method, options: dict[str, Any]) -> Method:
    """The method with these options of its second stage, and with a `crop` of its images."""
    options, deferred = dict(options), method.stage["deferred"]
    method = replace(method, data=replace(method.data, crop=options.pop("crop", None)))
    deferred = replace(deferred, shading=replace(deferred.shading, **options))
    return replace(method, stage=method.stage | {"deferred": deferred})


@pytest.mark.parametrize(
    "options, kept",
    [
        ({}, set()),
        ({"diffuse": "irradiance", "ambient_rays": 5}, {"mesh/ambient"}),
        ({"traced_bounces": 2}, {"mesh/surfels", "mesh/weights", "mesh/normals"}),
        ({"visibility_rays": 3, "antialias": True, "crop": 12 * 12}, set()),
    ],
)
def test_resume_repeats_straight_run_bit_for_bit(
    options: dict[str, Any], kept: set[str], method: Method, tmp_path: Path, one_thread: None
) -> None:
    data, method = ball(), with_deferred(method, options)
    straight = Trainer(method, data, run_folder(tmp_path / "straight", method))
    straight.train()
    first = Trainer(method, data, run_folder(tmp_path / "resumed", method))

    def stop(trainer: Trainer) -> None:
        if trainer.iteration == 16:  # after an edit of the table and a step with it
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.train(stop)
    second = Trainer(method, data, Run(tmp_path / "resumed"))
    assert second.iteration == 16 and kept <= require_same_state(first, second).keys()
    second.train()
    assert "mesh/faces" in require_same_state(straight, second)


def test_stage_has_its_own_rates(method: Method) -> None:
    initial = replace(method.stage["initial"], rates={"metallic": 0.0, "light": 0.1})
    slow = replace(without(method), stage=method.stage | {"initial": initial})
    first = {}
    for name, chosen in (("slow", slow), ("own", replace(slow, stage=method.stage))):
        trainer = Trainer(chosen, ball())
        before = {key: tensor.numpy().copy() for key, tensor in trainer.fit.params.items()}
        trainer.step()
        first[name] = {key: np.abs(x.numpy() - before[key]).max() for key, x in trainer.fit.params.items()}
    assert first["slow"]["metallic"] == 0 < first["own"]["metallic"]
    assert first["slow"]["light"] == pytest.approx(0.1 * first["own"]["light"], rel=1e-3)
    assert first["slow"]["albedo"] == pytest.approx(first["own"]["albedo"], rel=1e-3)
    step_to(trainer, 8)
    before_deferred = trainer.fit.params["metallic"].numpy().copy()
    trainer.step()
    assert np.abs(trainer.fit.params["metallic"].numpy() - before_deferred).max() > 0


@pytest.mark.parametrize("stage", ["initial", "deferred"])
def test_error_is_shared_by_surfels(stage: str, method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """They sum to the squared error times alpha, and each gets that of the pixels that show it."""
    method = replace(without(method, "mesh"), stage={"only": replace(method.stage[stage], until=30)})
    frames, errors = [], []
    render, measure = train.render, train.objective

    def rendered(*inputs: Any) -> Any:
        frames.append(render(*inputs))
        return frames[-1]

    def measured(*inputs: Any) -> Any:
        loss, error = measure(*inputs)
        errors.append(error)
        return loss, error

    monkeypatch.setattr(train, "render", rendered)
    monkeypatch.setattr(train, "objective", measured)
    trainer = Trainer(method, ball())
    trainer.step()
    found = trainer.fit.tables[0].error_sum.numpy()
    total = float(dr.sum(errors[0] * dr.detach(frames[0].alpha))[0])
    assert total > 0 and found.sum() == pytest.approx(total, rel=1e-4)


def test_a_step_on_a_crop_has_its_gradient(method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """As a step on the whole image that weighs the pixels of the crop alone."""
    only = {"only": replace(method.stage["deferred"], until=30)}
    plain = replace(without(method, "mesh"), stage=only, data=DataOptions(), loss={"l1": LossWeight(1)})
    cropped = Trainer(replace(plain, data=DataOptions(crop=12 * 12)), ball())
    column, row, width, height = cropped.setup.crop(1, SIZE, SIZE) or (0, 0, SIZE, SIZE)
    assert width == height == 8
    place = np.zeros((SIZE, SIZE), np.float32)
    place[row : row + height, column : column + width] = SIZE**2 / (width * height)
    weight, measure = mi.Float(place.ravel()), train.objective

    def of_part(inputs: Any, *others: Any) -> Any:
        _, error = measure(inputs, *others)
        difference = (dr.abs(a - b) for a, b in zip(inputs.image, inputs.target.image, strict=True))
        return dr.mean(weight * sum(difference)) / 3, error

    losses, gradients = [], []
    for trainer, loss in ((cropped, measure), (Trainer(plain, ball()), of_part)):
        monkeypatch.setattr(train, "objective", loss)
        params = trainer.fit.params
        monkeypatch.setattr(trainer.fit.optimiser, "step", lambda *_: None)
        trainer.step()
        gradients.append({name: dr.grad(tensor).numpy() for name, tensor in params.items()})
        losses.append(float(trainer.loss[0]))
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    for name, found in gradients[0].items():
        largest = np.abs(gradients[1][name]).max()
        np.testing.assert_allclose(found, gradients[1][name], atol=2e-5 * largest, err_msg=name)
    assert np.abs(gradients[0]["position"]).max() > 0


@pytest.mark.parametrize(
    ("sent", "raised", "saved"),
    [
        ([signal.SIGINT], KeyboardInterrupt, 7),
        ([signal.SIGTERM], TerminatedError, 7),
        ([signal.SIGTERM, signal.SIGINT], TerminatedError, 5),  # the second one is not held
    ],
)
@pytest.mark.usefixtures("heard_interrupts")
def test_signal_waits_for_step_in_hand(
    sent: list[int], raised: type, saved: int, method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Inside iteration 7, before its events: the newest checkpoint contains a whole iteration."""
    run, due = run_folder(tmp_path / "run", method), Densify.due

    def interrupted(event: Densify, trainer: Trainer) -> bool:
        for number in sent if trainer.iteration == 7 else ():
            os.kill(os.getpid(), number)
        return due(event, trainer)

    monkeypatch.setattr(Densify, "due", interrupted)
    trainer, before = Trainer(method, ball(), run), signal.getsignal(sent[0])
    with pytest.raises(KeyboardInterrupt) as caught:
        trainer.train()
    assert caught.type is raised and signal.getsignal(sent[0]) is before
    state = run.load_checkpoint()
    assert state is not None and int(state["iteration"]) == saved
    for name, value in trainer.fit.arrays().items():
        assert saved == 5 or np.array_equal(state[name], value), name


def test_signal_that_was_ignored_stays_ignored() -> None:
    """As of a job that a script put in the background."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with held_interrupts() as release:
            assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
            os.kill(os.getpid(), signal.SIGINT)
            release()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_full_disk_leaves_what_was_saved(method: Method, tmp_path: Path) -> None:
    """The checkpoint of iteration 10 does not fit: one sentence, no half file; that of 5 is still there."""
    run = run_folder(tmp_path / "run", method)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(trainer: Trainer) -> None:
        if trainer.iteration == 9:
            resource.setrlimit(resource.RLIMIT_FSIZE, (10_000, limits[1]))

    try:
        with pytest.raises(InputError, match=r"0000010\.npz: output: cannot be written \(.*\); free some"):
            Trainer(method, ball(), run).train(fill)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in (run.path / "checkpoints").iterdir()] == ["0000005.npz"]


@pytest.mark.parametrize(
    "options, most", [({}, 60), ({"crop": 12 * 12}, 60), ({"traced_bounces": 1, "antialias": True}, 130)]
)
def test_warm_step_compiles_nothing(options: dict[str, Any], most: int, method: Method) -> None:
    trainer = Trainer(without(with_deferred(method, options)), ball())
    step_to(trainer, 22)  # into the deferred stage, with a mesh
    launches, _, misses = dr.detail.launch_stats()
    at_vertices = trainer.fit.occluder.vertex_surfels
    step_to(trainer, 25)
    assert trainer.fit.occluder.vertex_surfels is at_vertices  # found once per mesh
    after, _, misses_after = dr.detail.launch_stats()
    assert misses_after == misses and (after - launches) / 3 < most


def test_shared_light_learns_sum_of_gradients(method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """The gradient that three steps leave together is the sum of those that each leaves alone."""
    assert method.light is not None
    rates, sums = Rates(attribute=dict.fromkeys(method.surfels.names, 0.0), light=0.0), {}
    for every in (1, 3):
        trainer = Trainer(replace(method, light=replace(method.light, every=every), rates=rates), ball())
        seen: list[np.ndarray] = []
        real = trainer.fit.optimiser.step

        def step(number: int, loss: Any, fit: Any = trainer.fit, seen: Any = seen, real: Any = real) -> None:
            seen.append(np.array(dr.grad(fit.params["light"]).array))
            real(number, loss)

        monkeypatch.setattr(trainer.fit.optimiser, "step", step)
        for _ in range(3):
            trainer.step()
        assert [bool(g.any()) for g in seen] == [every == 1, every == 1, True]
        sums[every] = sum(g for g in seen if g.any())
    scale = np.abs(sums[1]).max()
    assert scale > 0
    np.testing.assert_allclose(sums[3], sums[1], rtol=1e-4, atol=1e-5 * scale)
