"""Camera corrections: what is fitted, its derivative, when it is switched on, cameras that are recovered."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.common.scenes import discs
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.poses import poses_around
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.fitting import per_view
from mi_refgs.fitting.events.cameras import Cameras
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods import load_resolved
from mi_refgs.methods.method import POSE, DataOptions, Method
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.runs.run import CAMERAS, Run
from mi_refgs.runs.views import with_poses
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from tests.scenes.highlight import ball, require_same_state, run_folder, small_method, step_to

AFTER = 8


@pytest.fixture
def method(tmp_path: Path) -> Method:
    """Without coarse images and other events; cameras learn from iteration AFTER on."""
    return replace(small_method(tmp_path), event={"cameras": Cameras(AFTER)}, data=DataOptions())


def with_rows(trainer: Trainer, rows: np.ndarray) -> Trainer:
    """The trainer with corrections of these values (V, 6)."""
    trainer.fit.add(trainer.setup, POSE, upload_tensor(rows.astype(np.float32)))
    return trainer


def world_motion(trainer: Trainer, index: int) -> np.ndarray:
    """(4, 4): how the world would move to get from a view's camera to the corrected one."""
    old = trainer.data.views[index].to_world
    return np.asarray(trainer.camera(index).pose() @ np.linalg.inv(old))


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

    def total(table: np.ndarray, grad: bool = False) -> tuple[float, np.ndarray]:
        leaf = upload_tensor(table.astype(np.float32))
        if grad:
            dr.enable_grad(leaf)
        eye = per_view.corrected(trainer.setup, {POSE: leaf}, index, trainer.data.views[index].camera())
        found = dr.sum(dr.dot(weight, eye.to_camera(points)))
        if grad:
            dr.backward(found)
        return float(found[0]), dr.grad(leaf).numpy()

    _, gradient = total(rows, grad=True)
    assert np.flatnonzero(gradient.any(axis=1)).tolist() == [index]
    expected = np.zeros(6)
    for i in range(6):
        sides = [total(opposed(trainer, rows, index, i, sign * step))[0] for sign in (1, -1)]
        expected[i] = (sides[0] - sides[1]) / (2 * step)
    np.testing.assert_allclose(gradient[index], expected, atol=2e-3 * np.abs(expected).max())


def opposed(trainer: Trainer, rows: np.ndarray, index: int, i: int, change: float) -> np.ndarray:
    """Rows with entry i of a view changed, and the next view's so that the mean of all stays: a step treats
    the mean as a constant."""
    moved, three, other = rows.copy(), slice(3 * (i // 3), 3 * (i // 3) + 3), (index + 1) % len(rows)
    own, axes = (trainer.data.views[j].to_world[:3, :3] for j in (index, other))
    moved[index, i] += change
    moved[other, three] -= axes.T @ own[:, i % 3] * change
    return moved


@pytest.mark.parametrize("stop", [AFTER - 1, AFTER + 3])
def test_fit_resumes_bit_for_bit(stop: int, method: Method, tmp_path: Path, one_thread: None) -> None:
    """Stopped before or after cameras begin to learn; recorded poses are those of the fit."""
    straight = step_to(Trainer(method, ball()), AFTER + 6)
    run = run_folder(tmp_path / "run", method)
    step_to(Trainer(method, ball(), run), stop).save()
    second = step_to(Trainer(method, ball(), Run(tmp_path / "run")), AFTER + 6)
    state = require_same_state(straight, second)
    assert np.abs(state[f"params/{POSE}"]).max() > 1e-4
    poses = {view.name: second.camera(i).pose().tolist() for i, view in enumerate(second.data.views)}
    run.write_json(CAMERAS, {"to_world": poses})
    for i, view in enumerate(with_poses(second.data, run.cameras()).views):
        np.testing.assert_array_equal(view.to_world, second.camera(i).pose())
    fewer = replace(ball(), views=ball().views[1:])
    for others in (fewer, replace(ball(), split="test")):
        assert with_poses(others, run.cameras()) is others
    second.save()
    with pytest.raises(InputError, match=r"pose: it has \(6, 6\), a fit .* \(5, 6\)"):
        Trainer(method, fewer, Run(tmp_path / "run"))


def test_warm_step_with_corrections_compiles_nothing(method: Method) -> None:
    """Another view has another pose, and no other kernel; a view's correction moves with its own gradient."""
    trainer = step_to(Trainer(method, ball()), 18)
    misses = dr.detail.launch_stats()[2]
    step_to(trainer, 22)
    assert dr.detail.launch_stats()[2] == misses
    trainer.fit.optimiser.reset(POSE)
    before = trainer.fit.params[POSE].numpy()
    trainer.step()
    moved = np.flatnonzero(np.any(trainer.fit.params[POSE].numpy() != before, axis=1))
    assert moved.tolist() == [trainer.setup.view(trainer.iteration)]


RADIANCE = """
iterations = 480
log_every = 20
[surfels]
attributes = ["radiance_sh"]
count = 300
max_count = 300
degree = { radiance_sh = 1 }
[stage.radiance]
until = 480
at = "surfel"
reflectance = "radiance"
[loss]
l1 = 1.0
normal = 0
[rates]
attribute = { position = 2e-5, radiance_sh = 2e-4, scale = 2e-4, rotation = 2e-4, opacity = 2e-4 }
[event.cameras]
after = 1
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
    outward = unit(rng.normal(size=(views, 3)) * [1, 1, 0.6])
    true = poses_around(outward, np.zeros(3), distance)
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
        image = np.stack([np.array(x) for x in displayed(frame, background, False)], -1)
        alpha = np.array(frame.alpha).reshape(size, size)
        pixels = Pixels(image.reshape(size, size, 3).clip(0, 1).astype(np.float32), alpha)
        made.append(replace(view, to_world=wrong[i], pixels=pixels))
    return Dataset(Path("discs"), "train", tuple(made), background, False, None), surfels, true


def unit(x: np.ndarray) -> np.ndarray:
    return np.asarray(x / np.linalg.norm(x, axis=-1, keepdims=True))


def pose_errors(trainer: Trainer, true: np.ndarray) -> tuple[float, float]:
    """Root mean square errors, degrees and fractions of the distance, after one rigid motion of all."""
    found = np.stack([trainer.camera(i).pose() for i in range(len(true))])
    axes = [poses_[:, :3, :3].transpose(0, 2, 1).reshape(-1, 3) for poses_ in (true, found)]
    whole = Rotation.align_vectors(*axes)[0]
    turns = whole * Rotation.from_matrix(found[:, :3, :3]) * Rotation.from_matrix(true[:, :3, :3]).inv()
    place, wanted = whole.apply(found[:, :3, 3]), true[:, :3, 3]
    offset = place - place.mean(axis=0) - (wanted - wanted.mean(axis=0))
    distance = np.linalg.norm(wanted, axis=1)
    moved = np.linalg.norm(offset, axis=1) / distance
    angle, far = (float(np.sqrt(np.mean(np.square(x)))) for x in (turns.magnitude(), moved))
    return float(np.degrees(angle)), far


def test_disturbed_cameras_are_recovered(tmp_path: Path, rng: np.random.Generator) -> None:
    """0.5° and 0.5 % of the distance, together with discs that learn, too."""
    path = tmp_path / "radiance.toml"
    path.write_text(RADIANCE)
    data, surfels, true = disturbed_discs(rng)
    trainer = Trainer(load_resolved(path), data)
    trainer.fit.tables[0].replace(surfels, tuple(surfels.raw))
    before = pose_errors(trainer, true)
    step_to(trainer, trainer.method.iterations)
    after = pose_errors(trainer, true)
    assert before[0] > 0.4 and before[1] > 0.004
    assert after[0] < 0.05 and after[1] < 5e-4
