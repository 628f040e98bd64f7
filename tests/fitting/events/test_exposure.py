"""Gains of images: what is fitted, its derivative, when they are switched on, what they cost elsewhere."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import fitted_gain
from mi_refgs.errors import InputError
from mi_refgs.fitting import image_error, per_view
from mi_refgs.fitting.events.exposure import DEAD_ZONE, Exposure
from mi_refgs.fitting.objective import LossInputs, objective
from mi_refgs.fitting.targets import Target
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import GAIN, LOSS_WEIGHTS, DataOptions, Method
from mi_refgs.reference import losses as reference
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.run import Run
from mi_refgs.splat import Camera
from tests.fitting.image_checks import BACKGROUND, HEIGHT, WIDTH, gradient, planes, shown, view_of
from tests.helpers import with_pixels
from tests.scenes.highlight import ball, require_same_state, run_folder, small_method, step_to

GAINS = np.array([1.4, 0.7, 0.9])
WEIGHTS = {name: LOSS_WEIGHTS[name] for name in ("l1", "gain")}
AFTER = 8
Picture = tuple[np.ndarray, np.ndarray]


@pytest.fixture
def picture(rng: np.random.Generator) -> Picture:
    """Premultiplied radiance, some of it beyond white, and alpha with empty and full pixels."""
    alpha = np.clip(rng.uniform(-0.5, 1.5, (HEIGHT, WIDTH)), 0, 1)
    return rng.uniform(0.01, 0.9, (HEIGHT, WIDTH, 3)) * alpha[..., None], alpha


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("has_alpha", [False, True])
def test_gain_is_found_beside_clipped_pixels(linear: bool, has_alpha: bool, picture: Picture) -> None:
    """An 8-bit image clips what the gain makes brighter than white."""
    radiance, alpha = picture
    if not has_alpha:
        radiance, alpha = radiance / np.maximum(alpha, 1e-9)[..., None], np.ones_like(alpha)
    image = shown(radiance, alpha, linear, GAINS)
    if not linear:
        limited = np.minimum(radiance * GAINS, alpha[..., None])
        clipped = reference.display_image(limited, alpha, (1.0, 0.5, 0.25))
        assert np.any(clipped < image - 0.05)
        image = clipped
    view = view_of(image, alpha if has_alpha else None, linear)
    found = fitted_gain(radiance, alpha, view, BACKGROUND)
    np.testing.assert_allclose(found, GAINS, rtol=2e-3)
    half = np.indices(alpha.shape)[0] < HEIGHT // 2
    radiance[~half] *= 3  # not looked at
    np.testing.assert_allclose(fitted_gain(radiance, alpha, view, BACKGROUND, half), GAINS, rtol=2e-3)
    assert np.all(fitted_gain(0 * radiance, alpha, view, BACKGROUND) == 1)


@pytest.mark.parametrize("linear", [False, True])
def test_exposure_and_its_derivative(linear: bool, picture: Picture, rng: np.random.Generator) -> None:
    """Value, both modes, against differences of the float64 definition; the prior is part of it."""
    radiance, alpha = (x.astype(np.float32).astype(np.float64) for x in picture)
    goal = shown(rng.uniform(0.01, 0.5, radiance.shape) * alpha[..., None], alpha, linear)
    view = view_of(goal, alpha, linear)
    data = Dataset(Path("a"), "train", (view,), BACKGROUND, linear, None)
    target = Target.of(view, BACKGROUND)
    clipped = np.zeros(radiance.shape, bool)
    if target.clipped is not None:
        clipped = np.stack([np.array(x) for x in target.clipped], -1).reshape(radiance.shape)
    encode = reference.srgb
    goal = encode(np.asarray(view.image, np.float64)) if linear else np.asarray(view.image, np.float64)

    def define(log: np.ndarray) -> float:
        image = shown(radiance, alpha, linear, np.exp(log))
        image = encode(image) if linear else image
        prior = WEIGHTS["gain"].weight * float(np.sum(log**2))
        return WEIGHTS["l1"].weight * reference.l1(image, goal, clipped) + prior

    log = np.array([0.3, -0.4, 0.2])
    leaves = [mi.Float(float(value)) for value in log]
    dr.enable_grad(leaves)
    frame = Frame(upload(alpha), upload(alpha), mi.Vector3f(0, 0, 1), mi.Color3f(*planes(radiance)))
    loss, _ = objective(LossInputs.of(frame, target, data, log_gain=leaves), WEIGHTS, 1)
    assert float(loss[0]) == pytest.approx(define(log), abs=3e-6)
    expected = gradient(define, log)
    dr.backward(loss, dr.ADFlag.ClearInterior)
    found = np.array([float(dr.grad(leaf)[0]) for leaf in leaves])
    np.testing.assert_allclose(found, expected, rtol=2e-4)
    for leaf, tangent in zip(leaves, (0.5, -1.0, 2.0), strict=True):
        dr.set_grad(leaf, mi.Float(tangent))
    moved, _ = objective(LossInputs.of(frame, target, data, log_gain=leaves), WEIGHTS, 1)
    dr.forward_to(moved)
    assert float(dr.grad(moved)[0]) == pytest.approx(expected @ [0.5, -1.0, 2.0], rel=2e-4)


def test_gain_of_open_scene_counts_what_lies_behind(picture: Picture) -> None:
    """Images without alpha show object, surroundings and background at one exposure."""
    radiance, alpha = picture
    behind = np.array([0.3, 0.2, 0.4])
    seen = radiance + (1 - alpha[..., None]) * behind
    view = view_of(np.vectorize(reference.srgb)(np.minimum(seen * GAINS, 1)), None, False)
    data = Dataset(Path("a"), "train", (view,), BACKGROUND, False, None)
    opacity, colour = upload(alpha), mi.Color3f(*(float(x) for x in behind))
    frame = Frame(opacity, opacity, None, mi.Color3f(*planes(radiance)), background=colour)
    gain, image = image_error.with_gain(frame, view, data)
    np.testing.assert_allclose(gain, GAINS, rtol=2e-3)
    np.testing.assert_allclose(np.minimum(image, 1), view.image, atol=2e-3)


def exposed(data: Dataset, log: np.ndarray) -> Dataset:
    """The data set with log gains (V, 3), or per pixel, on its 8-bit images with a white background."""
    views = []
    for view, gain in zip(data.views, np.exp(log), strict=True):
        assert view.alpha is not None
        alpha = view.alpha[..., None]
        colour = np.clip(srgb_from_linear(view.colour(data.background) * gain), 0, 1)
        image = (alpha * colour + (1 - alpha) * data.background).astype(np.float32)
        views.append(with_pixels(view, image=image))
    return replace(data, views=tuple(views))


@pytest.fixture
def method(tmp_path: Path) -> Method:
    """Without refinement, so that a few dozen steps settle."""
    small = small_method(tmp_path)
    rates = replace(small.rates, attribute={"albedo": 0.1, "radiance_sh": 0.1, "opacity": 0.2})
    small = replace(small, event={"exposure": Exposure(AFTER)}, rates=rates)
    return replace(small, data=DataOptions(), iterations=120)


def perfect(data: Dataset) -> Any:
    """In place of `Trainer.view`: frames that show the images of a data set as they are."""

    def frame(_: Trainer, camera: Camera, aovs: bool = True) -> Frame:
        [own] = [view for view in data.views if np.array_equal(view.camera().origin, camera.origin)]
        assert own.alpha is not None
        radiance = own.alpha[..., None] * own.colour(data.background)
        opacity = upload(own.alpha)
        return Frame(opacity, opacity, None, mi.Color3f(*(upload(radiance[..., c]) for c in range(3))))

    return frame


def test_gains_of_images(method: Method, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to the mean of all views, less the dead zone; images of one exposure have none."""
    log, said = rng.uniform(-0.5, 0.3, (12, 3)), list[str]()
    monkeypatch.setattr(Trainer, "view", perfect(ball(views=12)))
    for spread in (0.1, 1.0):
        trainer = Trainer(method, exposed(ball(views=12), spread * log), tell=said.append)
        trainer.fit.iteration = AFTER - 1
        trainer.happen()
        assert GAIN not in trainer.fit.params
        trainer.fit.iteration = AFTER
        trainer.happen()
        trainer.happen()
        expected = spread * (log - log.mean(axis=0))
        expected = np.sign(expected) * np.maximum(abs(expected) - DEAD_ZONE, 0)
        found = trainer.fit.params[GAIN].numpy()
        np.testing.assert_allclose(found, expected, atol=5e-3)
    assert len(said) == 2 and "exposure: gains of" in said[0]
    gains = per_view.gains_of(trainer.fit.params)
    assert gains is not None
    trainer.fit.params[GAIN] = trainer.fit.params[GAIN] + 0.3  # what all have in common is the scene's
    used = per_view.log_gain(trainer.fit.params, 3)
    assert used is not None
    np.testing.assert_allclose([float(value[0]) for value in used], np.log(gains[3]), atol=1e-6)


@pytest.mark.parametrize("stop", [AFTER - 1, AFTER + 3])
def test_fit_with_gains_resumes_bit_for_bit(
    stop: int, method: Method, rng: np.random.Generator, tmp_path: Path, one_thread: None
) -> None:
    """Stopped before or after the gains begin to learn."""
    method = replace(method, iterations=AFTER + 6)
    data = exposed(ball(), rng.uniform(-0.5, 0.3, (6, 3)))
    straight = step_to(Trainer(method, data), method.iterations)
    step_to(Trainer(method, data, run_folder(tmp_path / "run", method)), stop).save()
    said: list[str] = []
    second = Trainer(method, data, Run(tmp_path / "run"), tell=said.append)
    step_to(second, method.iterations)
    assert len(said) == (stop < AFTER) and f"params/{GAIN}" in require_same_state(straight, second)
    second.save()
    fewer = replace(data, views=data.views[1:])
    with pytest.raises(InputError, match=r"gain: it has \(6, 3\), a fit .* \(5, 3\)"):
        Trainer(method, fewer, Run(tmp_path / "run"))


def test_warm_step_with_gains_compiles_nothing(method: Method) -> None:
    """Another view has other gains, and no other kernel; a view's gain moves with its own gradient."""
    trainer = Trainer(replace(method, event={"exposure": Exposure(2)}), ball())
    step_to(trainer, 16)
    misses = dr.detail.launch_stats()[2]
    step_to(trainer, 20)
    assert dr.detail.launch_stats()[2] == misses
    for _ in range(2):
        trainer.fit.optimiser.reset(GAIN)
        before = trainer.fit.params[GAIN].numpy()
        trainer.step()
        index = trainer.setup.view(trainer.iteration)
        moved = np.flatnonzero(np.any(trainer.fit.params[GAIN].numpy() != before, axis=1))
        assert moved.tolist() == [index]
