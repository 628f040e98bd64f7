"""Painting of an object on views: which surfels it has, also where no painted view shows them."""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.editing.painting import Painting, selected_alpha
from mi_refgs.reference.camera import look_at
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera
from tests.scenes.known import CENTRES, known_scene, with_background

SIZE = 48


FRONT, SIDE = (0.3, -3.2, 0.7), (3.2, 0.0, 0.0)


def camera(place: tuple[float, float, float]) -> Camera:
    """From a place towards the origin."""
    pose = look_at(np.array(place), np.zeros(3))
    return Camera.from_pose(SIZE, SIZE, -1.6 * SIZE, -1.6 * SIZE, SIZE / 2, SIZE / 2, pose, 0.01)


def alpha(scene: TrainedScene, chosen: np.ndarray, place: tuple[float, float, float]) -> np.ndarray:
    return np.array(selected_alpha(scene, chosen, camera(place))).reshape(SIZE, SIZE)


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    mi.set_variant("llvm_ad_rgb")
    return known_scene()


@pytest.fixture(scope="module")
def metal(scene: TrainedScene) -> np.ndarray:
    """The surfels of the metal ball."""
    return np.arange(scene.surfels.count) % 2 == 0


def test_an_object_painted_in_one_view_is_whole(scene: TrainedScene, metal: np.ndarray) -> None:
    painting = Painting(scene)
    assert not painting.surfels().any()
    painting.paint(camera(FRONT), alpha(scene, metal, FRONT) > 0.5)
    assert 0.3 < painting.chosen[metal].mean() < 0.6  # the front
    assert painting.surfels()[metal].mean() > 0.98 and painting.surfels()[~metal].mean() < 0.06


def test_a_later_view_corrects_and_undo_restores(scene: TrainedScene, metal: np.ndarray) -> None:
    """From the side, one ball hides the other: what it hides stays as it was painted."""
    painting, everywhere = Painting(scene), np.ones((SIZE, SIZE), bool)
    painting.paint(camera(FRONT), everywhere)
    assert painting.surfels().all()
    painting.paint(camera(SIDE), everywhere, remove=True)
    position = scene.surfels.to_numpy()["position"] - CENTRES[~metal * 1]
    assert not painting.surfels()[~metal & (position[:, 0] > 0.1)].any()
    assert painting.surfels()[metal & (position[:, 1] < -0.1) & (abs(position[:, 2]) < 0.3)].all()
    painting.undo()
    assert painting.surfels().all()
    painting.undo()
    painting.undo()  # nothing is left
    assert not painting.surfels().any()


def test_other_surfels_and_the_background_occlude_a_selection(scene: TrainedScene, metal: np.ndarray) -> None:
    """From the side, the other ball leaves a ring of the larger one."""
    alone = replace(scene, surfels=with_background(scene).surfels)
    free = alpha(alone, np.ones(alone.surfels.count, bool), SIDE)
    behind = alpha(scene, metal, SIDE)
    both = alpha(scene, np.ones(len(metal), bool), SIDE)
    np.testing.assert_allclose(behind + alpha(scene, ~metal, SIDE), both, atol=1e-5)
    assert (behind > 0.5).sum() < 0.7 * (free > 0.5).sum()
    photographed = with_background(scene)
    np.testing.assert_allclose(alpha(photographed, np.ones(metal.sum(), bool), SIDE), behind, atol=1e-5)
