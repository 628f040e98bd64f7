"""Error budget: classes of pixels of surfaces in closed form, and shares of planted errors."""

import numpy as np
import pytest

from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.evaluation.error_budget import CLASSES, ErrorBudget, classify
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.evaluation.surface import TrueSurface
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.reference.camera import look_at

SIZE, DISTANCE = 60, 60.0
"""Pixels per side; distance of the camera from the origin on the x axis, where a pixel is 1 unit wide."""
ROWS, COLUMNS = slice(20, 40), slice(15, 45)  # pixels of the object


def view_of(slope: float, step: float) -> View:
    """The walls x = `slope` |y|, the one at y > 0 farther by `step`, cut out by ROWS and COLUMNS."""
    pose = look_at(np.array([DISTANCE, 0, 0]), np.zeros(3))
    black = np.zeros((SIZE, SIZE, 3), np.float32)
    bare = View("", SIZE, SIZE, SIZE, SIZE, SIZE / 2, SIZE / 2, pose, Pixels(black))
    y = np.array(bare.camera().rays())[1].reshape(SIZE, SIZE)  # of rays (-1, y, z)
    alpha = np.zeros((SIZE, SIZE), np.float32)
    alpha[ROWS, COLUMNS] = 1
    depth = alpha * (DISTANCE + step * (y > 0)) / (1 + slope * np.abs(y))
    normal = np.stack([np.ones_like(y), -slope * np.sign(y), np.zeros_like(y)], -1) / np.hypot(1, slope)
    maps = (normal * alpha[..., None]).astype(np.float32), depth.astype(np.float32)
    return View(*("", SIZE, SIZE, SIZE, SIZE, SIZE / 2, SIZE / 2, pose, Pixels(black, alpha)), *maps)


def walls(*sides: int) -> TrueSurface:
    """The walls x = |y| on these sides of y = 0, larger than what the camera sees."""
    corners = [[x, side * x, z] for side in sides for x in (0, 100) for z in (-100, 100)]
    faces = [[4 * i + k for k in face] for i in range(len(sides)) for face in ((0, 1, 2), (1, 3, 2))]
    return TrueSurface(Mesh(np.array(corners, np.float32), np.array(faces, np.uint32), 1e-3))


def expected(inner: str, edge: bool) -> np.ndarray:
    """Classes of `view_of`: the outline with 2 pixels on either side, the two columns at y = 0, the rest."""
    found = np.full((SIZE, SIZE), CLASSES.index("background"))
    found[18:42, 13:47] = CLASSES.index("silhouette")
    found[22:38, 17:43] = CLASSES.index(inner)
    if edge:
        found[22:38, 29:31] = CLASSES.index("crease")
    return found


@pytest.mark.parametrize(
    ("slope", "step", "edge"),
    [
        (0.2, 0, False),  # the normals turn by 23°
        (0.24, 0, True),  # by 27°
        (0, 0.4, False),  # the step leaves the walls by 22°
        (0, 0.55, True),  # by 29°
        (0, 5, True),
    ],
)
def test_creases_and_depth_edges(slope: float, step: float, edge: bool) -> None:
    np.testing.assert_array_equal(classify(view_of(slope, step), None), expected("smooth", edge))


def test_mirror_rays_are_blocked_by_the_other_wall_only() -> None:
    view = view_of(1, 0)
    np.testing.assert_array_equal(classify(view, walls(-1, 1)), expected("mirror_blocked", True))
    found = classify(view, walls(1))  # mirror rays of the wall at y > 0 are free
    assert found is not None
    at_left = np.array(view.camera().rays())[1].reshape(SIZE, SIZE) < 0
    free, blocked = expected("mirror_free", True), expected("mirror_blocked", True)
    np.testing.assert_array_equal(found, np.where(at_left, blocked, free))


def test_shares_of_planted_errors() -> None:
    """Over two views: errors and turned normals per class, and clipped colours."""
    rng, budget = np.random.default_rng(0), ErrorBudget()
    error = np.array([0.4, 0.3, 0.2, 0.1, 0.05, 0.01])
    degrees = np.array([30, 20, 10, 5, 2, 0])
    counts = np.zeros(len(CLASSES))
    for _ in range(2):
        view = view_of(0, 0)
        classes = rng.integers(0, len(CLASSES), (SIZE, SIZE))
        turn = np.radians(degrees)[classes]
        normal = np.stack([np.cos(turn), np.sin(turn), 0 * turn], -1)
        image = np.where(classes == 0, -0.7, error[classes])  # below 0 is displayed as the true 0
        rendered = RenderedView(np.repeat(image[..., None], 3, -1), view.covered(), normal, {})
        budget.add(rendered, view, classes)
        counts += np.bincount(classes.ravel(), minlength=len(CLASSES))
    error[0] = 0
    found = budget.result()["error_budget"]
    assert list(found) == list(CLASSES)
    np.testing.assert_allclose([row["pixels"] for row in found.values()], counts / counts.sum())
    shares = counts * error**2 / np.sum(counts * error**2)
    np.testing.assert_allclose([row["squared_error"] for row in found.values()], shares)
    np.testing.assert_allclose([row["normal_mae_deg"] for row in found.values()], degrees, atol=1e-6)
