"""Registration of cameras: poses that are found again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.data.images import Pixels
from mi_refgs.data.registration import registered
from mi_refgs.data.view import View
from mi_refgs.io.images import box_downscale
from mi_refgs.reference.camera import look_at
from tests.scenes.dots import dots

POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (12, 3))
SIZE, FOCAL, DISTANCE = 112, 150.0, 3.0


def render(view: View) -> np.ndarray:
    """Dots in space, on an image of any size."""
    row, column, _ = view.project(POINTS)
    plane = dots(view.width, view.height, column + 0.5, row + 0.5, 4 * view.width / SIZE)
    return np.repeat(0.8 * plane[..., None], 3, axis=2)


def disturbed(rng: np.random.Generator) -> tuple[View, np.ndarray]:
    """A view whose pose is wrong by 1° and by 1 % of the distance, and the pose of its image."""
    pose = look_at(DISTANCE * np.array([0.6, 0.7, 0.4]), np.zeros(3))
    view = View(
        "a", SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, pose, Pixels(np.zeros((SIZE, SIZE, 3), np.float32))
    )
    view = replace(view, pixels=Pixels(render(view).astype(np.float32)))
    axis, shift = (x / np.linalg.norm(x) for x in rng.normal(size=(2, 3)))
    wrong = pose.copy()
    wrong[:3, :3] = Rotation.from_rotvec(np.radians(1.0) * axis).as_matrix() @ pose[:3, :3]
    wrong[:3, 3] += 0.01 * DISTANCE * shift
    return replace(view, to_world=wrong), pose


def errors(found: np.ndarray, pose: np.ndarray) -> tuple[float, float]:
    """Degrees, and fraction of the distance."""
    turn = Rotation.from_matrix(found[:3, :3] @ pose[:3, :3].T).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found[:3, 3] - pose[:3, 3])) / DISTANCE


def test_disturbed_pose_is_found(rng: np.random.Generator) -> None:
    view, pose = disturbed(rng)
    degrees, moved = errors(registered(view, render, DISTANCE).to_world, pose)
    assert degrees < 0.02 and moved < 5e-4


def test_pose_stays_where_no_other_is_better() -> None:
    """At the pose of the image, and for renders that do not depend on it."""
    pose = look_at(DISTANCE * np.array([0.6, 0.7, 0.4]), np.zeros(3))
    view = View("a", 16, 16, 20, 20, 8, 8, pose, Pixels(np.full((16, 16, 3), 0.5, np.float32)))
    found = registered(view, lambda other: np.full((other.height, other.width, 3), 0.4), DISTANCE)
    np.testing.assert_array_equal(found.to_world, pose)


def test_a_true_pose_stays_if_renders_lack_detail(rng: np.random.Generator) -> None:
    """Renders of half the resolution, as of a blurred fit, are best where the image is."""
    view, pose = disturbed(rng)
    view = replace(view, to_world=pose)

    def blurred(moved: View) -> np.ndarray:
        image = box_downscale(render(moved), 2)
        return image.repeat(2, axis=0).repeat(2, axis=1)

    degrees, moved = errors(registered(view, blurred, DISTANCE).to_world, pose)
    assert degrees < 0.1 and moved < 2e-3
