"""Cameras that are displaced: their numbers, and derivatives of images against float64."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.stability import exact
from benchmarks.stability.cases import camera
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.splat import Camera
from tests.scenes.camera_motion import CENTRE, moved_pose, require_slopes, rotation_of
from tests.scenes.open_pair import CASES, Pair, weighted


def displaced(eye: Camera, motion: "mi.Float") -> Camera:
    """A camera that is moved in this way, by (6,) numbers under AD."""
    rotation, translation = rotation_of(motion)
    return eye.displaced(rotation, mi.Point3f(CENTRE), translation)


MOTION = (0.2 * np.array([0.3, -0.5, 0.4, 0.2, 0.3, -0.1])).astype(np.float32)  # far from the pose itself


@pytest.mark.parametrize("far", [0.0, 1e4])
def test_displaced_camera_is_at_its_pose(far: float) -> None:
    """In float64; also far from the world's origin, where float32 resolves a thousandth."""
    pose, expected = camera().to_world.copy(), moved_pose(camera().to_world, MOTION.astype(np.float64))
    for matrix in (pose, expected):
        matrix[:3, 3] += far
    eye = Camera.from_pose(8, 8, -9, -9, 4, 4, pose)
    rotation, translation = rotation_of(mi.Float(MOTION))
    found = eye.displaced(rotation, mi.Point3f(CENTRE + far), translation)
    np.testing.assert_allclose(found.pose(), expected, atol=2e-6)
    assert found.motion is None


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(map(str, case)))
def test_derivatives_of_open_scene_are_those_of_float64(case: tuple[str, str, float]) -> None:
    """Both modes, for every map of object, surroundings and background, shaded in either order."""
    pair = Pair(*case)
    start = np.linalg.inv(moved_pose(np.eye(4), MOTION.astype(np.float64))) @ pair.case.camera.to_world
    eye = exact.fast_camera(pair.case).moved(start)

    def total(leaf: mi.Float) -> mi.Float:
        params = {name: upload_tensor(x) for name, x in pair.values.items()}
        return weighted(pair.planes(params, displaced(eye, leaf)), pair.weights)

    require_slopes(total, lambda at: pair.loss(pair.values, moved_pose(start, at)), MOTION)


def test_normals_of_depth_turn_with_camera() -> None:
    rng = np.random.default_rng(4)
    depth = (3 + 0.05 * rng.normal(size=(8, 9))).astype(np.float32).ravel()
    eye = Camera.from_pose(9, 8, -9, -9, 4.5, 4, camera().to_world)
    weight = rng.normal(size=(3, 72)).astype(np.float32)

    def total(leaf: mi.Float) -> mi.Float:
        normal, _ = normals_from_depth(upload(depth), mi.Float(1), displaced(eye, leaf))
        return sum((dr.sum(x * upload(w)) for x, w in zip(normal, weight, strict=True)), mi.Float(0))

    still, _ = normals_from_depth(upload(depth), mi.Float(1), eye)

    def define(at: np.ndarray) -> float:
        turn = Rotation.from_quat([*(0.5 * at[:3]), 1]).as_matrix()
        return float(np.sum(weight * (turn @ np.array(still, np.float64))))

    require_slopes(total, define, MOTION)
