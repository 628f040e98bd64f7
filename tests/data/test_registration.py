"""Registration of cameras: poses that are found again."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_refgs.data.images import Pixels
from mi_refgs.data.registration import registered
from mi_refgs.data.view import View
from mi_refgs.io.images import box_downscale
from mi_refgs.reference.camera import look_at
from tests.scenes.dots import dots

POINTS = np.random.default_rng(3).uniform(-0.6, 0.6, (12, 3))
SIZE, FOCAL, DISTANCE = 112, 150.0, 3.0
POSE = look_at(DISTANCE * np.array([0.6, 0.7, 0.4]), np.zeros(3))
HALF = (np.indices((SIZE, SIZE)) // 16).sum(axis=0) % 2 == 0


def render(view: View) -> np.ndarray:
    """Dots in space, on an image of any size."""
    row, column, _ = view.project(POINTS)
    plane = dots(view.width, view.height, column + 0.5, row + 0.5, 4 * view.width / SIZE)
    return np.repeat(0.8 * plane[..., None], 3, axis=2)


@pytest.fixture
def view() -> View:
    """The view that the dots are seen in."""
    blank = Pixels(np.zeros((SIZE, SIZE, 3), np.float32))
    view = View("a", SIZE, SIZE, FOCAL, FOCAL, SIZE / 2, SIZE / 2, POSE, blank)
    return replace(view, pixels=Pixels(render(view).astype(np.float32)))


def errors(found: np.ndarray) -> tuple[float, float]:
    """Degrees, and fraction of the distance."""
    turn = Rotation.from_matrix(found[:3, :3] @ POSE[:3, :3].T).magnitude()
    return float(np.degrees(turn)), float(np.linalg.norm(found[:3, 3] - POSE[:3, 3])) / DISTANCE


def test_disturbed_pose_is_found(view: View, rng: np.random.Generator) -> None:
    """It is wrong by 1° and by 1 % of the distance: too far for the derivatives of where it begins."""
    for pair in rng.normal(size=(6, 2, 3)):
        axis, shift = (x / np.linalg.norm(x) for x in pair)
        wrong = POSE.copy()
        wrong[:3, :3] = Rotation.from_rotvec(np.radians(1.0) * axis).as_matrix() @ POSE[:3, :3]
        wrong[:3, 3] += 0.01 * DISTANCE * shift
        degrees, moved = errors(registered(replace(view, to_world=wrong), render, DISTANCE, HALF).to_world)
        assert degrees < 0.02 and moved < 5e-4


def test_pose_stays_where_no_other_is_better(view: View) -> None:
    """For renders that do not depend on it."""
    found = registered(view, lambda other: np.full((other.height, other.width, 3), 0.4), DISTANCE, HALF)
    np.testing.assert_array_equal(found.to_world, POSE)


def test_a_true_pose_stays_if_renders_lack_detail(view: View) -> None:
    """Renders of half the resolution, as of a blurred fit, are best where the image is."""

    def blurred(moved: View) -> np.ndarray:
        return box_downscale(render(moved), 2).repeat(2, axis=0).repeat(2, axis=1)

    degrees, moved = errors(registered(view, blurred, DISTANCE, np.ones_like(HALF)).to_world)
    assert degrees < 0.1 and moved < 2e-3
