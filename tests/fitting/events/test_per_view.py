"""Gains of images and corrections of cameras: what is fitted, its derivative, when they begin to learn."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.common.scenes import discs
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import fitted_gain
from mi_refgs.data.images import Pixels
from mi_refgs.data.poses import poses_around
from mi_refgs.data.view import View
from mi_refgs.fitting import image_error, per_view
from mi_refgs.fitting.events.per_view import DEAD_ZONE, Cameras, Exposure, _moved
from mi_refgs.fitting.objective import LossInputs, objective
from mi_refgs.fitting.runner import begin
from mi_refgs.fitting.targets import Target
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.methods.method import GAIN, LOSS_WEIGHTS, POSE, CoarseImages, DataOptions, Method
from mi_refgs.reference import losses as reference
from mi_refgs.render.display import displayed, image_array
from mi_refgs.render.pipeline import Frame, SurfelScene, render
from mi_refgs.runs.run import CAMERAS, Run
from mi_refgs.runs.views import with_poses
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.fitting.image_checks import BACKGROUND, HEIGHT, gradient, picture, planes, shown, view_of
from tests.helpers import refused, unit, with_grad, with_pixels
from tests.scenes.highlight import ball, require_same_state, run_folder, small_method, step_to

GAINS = np.array([1.4, 0.7, 0.9])
WEIGHTS = {name: LOSS_WEIGHTS[name] for name in ("l1", "gain")}
AFTER = 8


@pytest.fixture
def method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Method:
    """Without coarse images and other events; gains and cameras, which seem wrong, learn from AFTER on."""
    monkeypatch.setattr("mi_refgs.fitting.events.per_view._moved", lambda trainer, view: 1.0)
    events: dict[str, Any] = {"exposure": Exposure(), "cameras": Cameras()}
    return replace(small_method(tmp_path), iterations=5 * AFTER, event=events, data=DataOptions())


@pytest.mark.parametrize("linear", [False, True])
@pytest.mark.parametrize("has_alpha", [False, True])
def test_gain_is_found_beside_clipped_pixels(linear: bool, has_alpha: bool, rng: np.random.Generator) -> None:
    """An 8-bit image clips what the gain makes brighter than white."""
    radiance, alpha = picture(rng)
    if not has_alpha:
        radiance, alpha = radiance / np.maximum(alpha, 1e-9)[..., None], np.ones_like(alpha)
    image = shown(radiance, alpha, linear, GAINS)
    if not linear:
        limited = np.minimum(radiance * GAINS, alpha[..., None])
        clipped = reference.display_image(limited, alpha, (1.0, 0.5, 0.25))
        assert np.any(clipped < image - 0.05)
        image = clipped
    view = view_of(image, alpha if has_alpha else None, linear)
    np.testing.assert_allclose(fitted_gain(radiance, alpha, view, BACKGROUND), GAINS, rtol=2e-3)
    half = np.indices(alpha.shape)[0] < HEIGHT // 2
    radiance[~half] *= 3  # not looked at
    np.testing.assert_allclose(fitted_gain(radiance, alpha, view, BACKGROUND, half), GAINS, rtol=2e-3)
    assert np.all(fitted_gain(0 * radiance, alpha, view, BACKGROUND) == 1)


@pytest.mark.parametrize("linear", [False, True])
def test_exposure_and_its_derivative(linear: bool, rng: np.random.Generator) -> None:
    """Value, both modes, against differences of the float64 definition; the prior is part of it."""
    radiance, alpha = (x.astype(np.float32).astype(np.float64) for x in picture(rng))
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
    leaves = with_grad([mi.Float(float(value)) for value in log])
    frame = Frame(upload(alpha), upload(alpha), mi.Vector3f(0, 0, 1), mi.Color3f(*planes(radiance)))
    loss, _ = objective(LossInputs.of(frame, target, data, log_gain=leaves), WEIGHTS, 1)
    assert float(loss[0]) == pytest.approx(define(log), abs=3e-6)
    expected = gradient(define, log)
    dr.backward(loss, dr.ADFlag.ClearInterior)
    np.testing.assert_allclose([float(dr.grad(leaf)[0]) for leaf in leaves], expected, rtol=2e-4)
    for leaf, tangent in zip(leaves, (0.5, -1.0, 2.0), strict=True):
        dr.set_grad(leaf, mi.Float(tangent))
    moved, _ = objective(LossInputs.of(frame, target, data, log_gain=leaves), WEIGHTS, 1)
    dr.forward_to(moved)
    assert float(dr.grad(moved)[0]) == pytest.approx(expected @ [0.5, -1.0, 2.0], rel=2e-4)


def test_gain_of_open_scene_counts_what_lies_behind(rng: np.random.Generator) -> None:
    """Images without alpha show object, surroundings and background at one exposure."""
    radiance, alpha = picture(rng)
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
    """Up to the mean of all views, less the dead zone; images of one exposure have none, and none learns."""
    log, said = rng.uniform(-0.5, 0.3, (12, 3)), list[str]()
    monkeypatch.setattr(Trainer, "view", perfect(ball(views=12)))
    for spread in (0.03, 1.0):
        trainer = Trainer(method, exposed(ball(views=12), spread * log), tell=said.append)
        trainer.fit.iteration = AFTER - 1
        trainer.happen()
        assert GAIN not in trainer.fit.params
        trainer.fit.iteration = AFTER
        trainer.happen()
        trainer.happen()
        expected = spread * (log - log.mean(axis=0))
        expected = np.sign(expected) * np.maximum(abs(expected) - DEAD_ZONE, 0)
        if spread < 1:
            assert GAIN not in trainer.fit.params and POSE in trainer.fit.params
            continue
        np.testing.assert_allclose(trainer.fit.params[GAIN].numpy(), expected, atol=5e-3)
    assert "exposure are left out: gains of 1.00" in said[0] and "exposure stay: gains of" in said[2]
    gains = per_view.gains_of(trainer.fit.params)
    assert gains is not None
    trainer.fit.params[GAIN] = trainer.fit.params[GAIN] + 0.3  # what all have in common is the scene's
    used = per_view.log_gain(trainer.fit.params, 3)
    assert used is not None
    np.testing.assert_allclose([float(value[0]) for value in used], np.log(gains[3]), atol=1e-6)


def test_told_gains_learn_from_the_first_step(
    method: Method, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The decision comes before the run folder exists, which has it nevertheless."""
    log = np.linspace(-0.5, 0.5, 18).reshape(6, 3).astype(np.float32)
    monkeypatch.setattr("mi_refgs.fitting.events.per_view.told_gains", lambda views: log)
    trainer = begin(method, ball(), run := Run(tmp_path / "run"))
    np.testing.assert_array_equal(trainer.fit.params[GAIN].numpy(), log)
    assert POSE not in trainer.fit.params and [x["component"] for x in run.decisions()] == ["exposure"]
    trainer.step()
    moved = np.flatnonzero((trainer.fit.params[GAIN].numpy() != log).any(axis=1))
    assert moved.tolist() == [trainer.setup.view(1)]


def with_rows(trainer: Trainer, rows: np.ndarray) -> Trainer:
    """The trainer with corrections of these values (V, 6)."""
    trainer.fit.add(trainer.setup, POSE, upload_tensor(rows.astype(np.float32)))
    return trainer


def world_motion(trainer: Trainer, index: int) -> np.ndarray:
    """(4, 4): how the world would move to get from a view's camera to the corrected one."""
    return np.asarray(trainer.posed(index).to_world @ np.linalg.inv(trainer.data.views[index].to_world))


def test_corrections_are_motions_about_focus_without_their_mean(method: Method) -> None:
    """A motion that all cameras have in common is none; others are rotations about the focus."""
    trainer = Trainer(method, ball())
    axes = np.stack([view.to_world[:3, :3] for view in trainer.data.views])
    common = np.concatenate([np.array([0.02, -0.01, 0.03]) @ axes, np.array([0.1, 0.2, -0.1]) @ axes], axis=1)
    with_rows(trainer, common)
    for index in range(6):
        np.testing.assert_allclose(world_motion(trainer, index), np.eye(4), atol=1e-6)
    turn = np.zeros((6, 6))
    turn[:, :3] = np.array([0.0, 0, 0.1]) @ axes * (1 - 2 * (np.arange(6) % 2))[:, None]
    with_rows(trainer, common + turn)
    change = world_motion(trainer, 0)
    expected = Rotation.from_rotvec([0, 0, 2 * np.arctan(0.05)]).as_matrix()
    np.testing.assert_allclose(change[:3, :3], expected, atol=1e-6)
    focus = trainer.setup.focus
    np.testing.assert_allclose(change[:3, :3] @ focus + change[:3, 3], focus, atol=1e-6)


def test_derivative_of_corrected_camera(method: Method, rng: np.random.Generator) -> None:
    """With respect to the row of its view, from points in its frame; other rows and the mean have none."""
    trainer, index, step = Trainer(method, ball()), 2, 1e-2
    rows, points = 0.05 * rng.normal(size=(6, 6)), mi.Point3f(rng.normal(size=(3, 20)).astype(np.float32))
    weight = mi.Vector3f(rng.normal(size=(3, 20)).astype(np.float32))

    def total(table: Any) -> Any:
        eye = per_view.corrected(trainer.setup, {POSE: table}, index, trainer.data.views[index].camera())
        return dr.sum(dr.dot(weight, eye.to_camera(points)))

    leaf = with_grad(upload_tensor(rows))
    dr.backward(total(leaf))
    gradient = dr.grad(leaf).numpy()
    assert np.flatnonzero(gradient.any(axis=1)).tolist() == [index]
    expected = np.zeros(6)
    for i in range(6):
        sides = [opposed(trainer, rows, index, i, sign * step) for sign in (1, -1)]
        above, below = (float(total(upload_tensor(side))[0]) for side in sides)
        expected[i] = (above - below) / (2 * step)
    np.testing.assert_allclose(gradient[index], expected, atol=2e-3 * np.abs(expected).max())


def opposed(trainer: Trainer, rows: np.ndarray, index: int, i: int, change: float) -> np.ndarray:
    """Rows with entry i of a view changed, and the next view's so that the mean stays, a step's constant."""
    moved, three, other = rows.copy(), slice(3 * (i // 3), 3 * (i // 3) + 3), (index + 1) % len(rows)
    own, axes = (trainer.data.views[j].to_world[:3, :3] for j in (index, other))
    moved[index, i] += change
    moved[other, three] -= axes.T @ own[:, i % 3] * change
    return moved


@pytest.mark.parametrize("stop", [AFTER - 1, AFTER + 3])
def test_fit_resumes_bit_for_bit(
    stop: int, method: Method, rng: np.random.Generator, tmp_path: Path, one_thread: None
) -> None:
    """Stopped before or after gains and cameras begin to learn; recorded poses are those of the fit."""
    data, said = exposed(ball(), rng.uniform(-0.5, 0.3, (6, 3))), list[str]()
    straight = step_to(Trainer(method, data), AFTER + 6)
    run = run_folder(tmp_path / "run", method)
    step_to(Trainer(method, data, run), stop).save()
    second = step_to(Trainer(method, data, Run(tmp_path / "run"), tell=said.append), AFTER + 6)
    state = require_same_state(straight, second)
    assert len(said) == 2 * (stop < AFTER) and f"params/{GAIN}" in state
    assert np.abs(state[f"params/{POSE}"]).max() > 1e-4
    assert second.setup.groups(second.fit.params)[POSE].begin == AFTER
    poses = [second.camera(i).pose().tolist() for i in range(len(data.views))]
    run.write_json(CAMERAS, {"to_world": dict(zip((view.name for view in data.views), poses, strict=True))})
    for i, view in enumerate(with_poses(data, run.record(CAMERAS)).views):
        np.testing.assert_array_equal(view.to_world, second.camera(i).pose())
    fewer = replace(data, views=data.views[1:])
    for others in (fewer, replace(data, split="test")):
        assert with_poses(others, run.record(CAMERAS)) is others
    for name, other, width in ((GAIN, POSE, 3), (POSE, GAIN, 6)):
        one = {key: values for key, values in state.items() if key != f"params/{other}"}
        words = f"{name}: it has (6, {width}), a fit", f"(5, {width})"
        refused(partial(Trainer, method, fewer, state=one), *words)


def test_warm_step_compiles_nothing(method: Method, rng: np.random.Generator) -> None:
    """Another view has another gain and pose, and no other kernel; its rows move with their own gradient."""
    trainer = step_to(Trainer(method, exposed(ball(), rng.uniform(-0.5, 0.3, (6, 3)))), 18)
    misses = dr.detail.launch_stats()[2]
    step_to(trainer, 22)
    assert dr.detail.launch_stats()[2] == misses
    for name in (GAIN, POSE):
        trainer.fit.optimiser.reset(name)
        before = trainer.fit.params[name].numpy()
        trainer.step()
        moved = np.flatnonzero(np.any(trainer.fit.params[name].numpy() != before, axis=1))
        assert moved.tolist() == [trainer.setup.view(trainer.iteration)]


RADIANCE = """
iterations = 480
log_every = 20
surfels = { attributes = ["radiance_sh"], count = 300, max_count = 300, degree = { radiance_sh = 1 } }
stage.radiance = { until = 480, at = "surfel", reflectance = "radiance" }
loss = { l1 = 1.0, normal = 0 }
rates.attribute = { position = 2e-5, radiance_sh = 2e-4, scale = 2e-4, rotation = 2e-4, opacity = 2e-4 }
event.cameras.after = 1
"""


def disturbed_discs(rng: np.random.Generator) -> tuple[Dataset, Surfels, np.ndarray]:
    """Images of discs, with poses that are wrong by 0.5° and 0.5 % of the distance; the discs; the poses."""
    views, size = 12, 64
    raw = {name: x.astype(np.float32) for name, x in discs(300, 5, degree=1).items()}
    raw = {name: raw[name] for name in ("position", "rotation", "scale", "opacity", "radiance_sh")}
    raw["scale"] -= 1.0
    raw["opacity"] += 3.0
    raw["radiance_sh"][:, :3] = rng.normal(size=(300, 3))
    surfels, distance = Surfels.from_numpy(raw), 4.0
    scene = SurfelScene(surfels, Shading(at="surfel", reflectance="radiance"))
    true = poses_around(unit(rng.normal(size=(views, 3)) * [1, 1, 0.6]), np.zeros(3), distance)
    # Disturbances without the motion that all cameras have in common: it would be the scene's.
    eye, turn = true[:, :3, 3], np.radians(0.5) * unit(rng.normal(size=(views, 3)))
    shift = 0.005 * distance * unit(rng.normal(size=(views, 3))) - np.cross(turn, eye)
    turn, shift = turn - turn.mean(axis=0), shift - shift.mean(axis=0)
    wrong = true.copy()
    wrong[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ true[:, :3, :3]
    wrong[:, :3, 3] += shift + np.cross(turn, eye)
    made, background = [], np.ones(3, np.float32)
    for i, pose in enumerate(true):
        intrinsics = (size, size, 1.4 * size, 1.4 * size, size / 2, size / 2)
        view = View(f"{i}", *intrinsics, pose, Pixels(np.zeros((size, size, 3), np.float32)))
        frame = render(scene, view.camera())
        image = image_array([*displayed(frame, background, False), frame.alpha], size, size)
        made.append(replace(view, to_world=wrong[i], pixels=Pixels(image[..., :3].clip(0, 1), image[..., 3])))
    return Dataset(Path("discs"), "train", tuple(made), background, False, None), surfels, true


def pose_errors(trainer: Trainer, true: np.ndarray) -> tuple[float, float]:
    """Root mean square errors, degrees and fractions of the distance, after one rigid motion of all."""
    found = np.stack([trainer.camera(i).pose() for i in range(len(true))])
    axes = [poses_[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3) for poses_ in (true, found)]
    whole = Rotation.align_vectors(*axes)[0]
    turns = whole * Rotation.from_matrix(found[:, :3, :3]) * Rotation.from_matrix(true[:, :3, :3]).inv()
    place, wanted = whole.apply(found[:, :3, 3]), true[:, :3, 3]
    offset = place - place.mean(axis=0) - (wanted - wanted.mean(axis=0))
    moved = np.linalg.norm(offset, axis=1) / np.linalg.norm(wanted, axis=1)
    angle, far = (float(np.sqrt(np.mean(np.square(x)))) for x in (turns.magnitude(), moved))
    return float(np.degrees(angle)), far


def test_disturbed_cameras_are_recovered(tmp_path: Path, rng: np.random.Generator) -> None:
    """0.5° and 0.5 % of the distance, together with discs that learn, too."""
    data, surfels, true = disturbed_discs(rng)
    trainer = Trainer(small_method(tmp_path, RADIANCE), data)
    trainer.fit.tables[0].replace(surfels, tuple(surfels.raw))
    method, moved = trainer.method, _moved(trainer, 0)
    trainer.take(trainer, replace(method, data=DataOptions(coarse=(CoarseImages(9),))))
    assert moved != _moved(trainer, 0) == pytest.approx(moved, rel=0.3)  # of the whole image, not of averages
    trainer.take(trainer, method)
    before = pose_errors(trainer, true)
    after = pose_errors(step_to(trainer, trainer.method.iterations), true)
    assert before[0] > 0.4 and before[1] > 0.004 and after[0] < 0.05 and after[1] < 5e-4


def test_averaged_images_align(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """Renders of several samples are compared with them: one sample aliases, and ends 0.26 pixels off."""
    monkeypatch.setattr(image_error, "REGISTERED", 32**2)
    data, surfels, true = disturbed_discs(rng)
    scene = SurfelScene(surfels, Shading(at="surfel", reflectance="radiance"))
    corners, off = unit(rng.normal(size=(8, 3))) / 2, []
    for view, pose in zip(data.views[:6], true, strict=False):
        frame, everywhere = render(scene, view.camera()), np.ones((view.height, view.width), bool)
        found = image_error.aligned(view, frame, partial(render, scene), data, everywhere)
        ends = [np.stack(one.project(corners)[:2]) for one in (found, replace(view, to_world=pose))]
        off.append(np.linalg.norm(ends[0] - ends[1], axis=0).mean())
    assert np.mean(off) < 0.12


def test_exact_cameras_stay(tmp_path: Path, rng: np.random.Generator) -> None:
    """The images of exact surfels, from poses 0.05 pixels off."""
    said = list[str]()
    data, surfels, true = disturbed_discs(rng)
    nearly = [0.95 * pose + 0.05 * view.to_world for view, pose in zip(data.views, true, strict=True)]
    views = [replace(view, to_world=pose) for view, pose in zip(data.views, nearly, strict=True)]
    trainer = Trainer(small_method(tmp_path, RADIANCE), replace(data, views=tuple(views)), tell=said.append)
    trainer.fit.tables[0].replace(surfels, tuple(surfels.raw))
    step_to(trainer, 3)
    assert POSE not in trainer.fit.params
    assert len(said) == 1 and "corrections of cameras are left out: 8 images fit 0.0" in said[0]
