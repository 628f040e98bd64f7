"""Rigid motions of a camera about a point, and a test of derivatives with respect to them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial.transform import Rotation

from tests.helpers import with_grad

CENTRE = np.array([0.3, -0.2, 0.1])
STEP = 1e-6


def moved_pose(pose: np.ndarray, motion: np.ndarray) -> np.ndarray:
    """A pose rotated (3, axis times 2 tan(θ/2)) about CENTRE, then moved (3)."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_quat([*(0.5 * motion[:3]), 1]).as_matrix()
    change[:3, 3] = CENTRE - change[:3, :3] @ CENTRE + motion[3:]
    return np.asarray(change @ pose)


def rotation_of(motion: mi.Float) -> tuple[mi.Matrix3f, mi.Vector3f]:
    """The rotation of a motion of (6,) numbers and its translation, under AD."""
    x = [dr.gather(mi.Float, motion, dr.opaque(mi.UInt32, i)) for i in range(6)]
    q = dr.normalize(mi.Quaternion4f(0.5 * x[0], 0.5 * x[1], 0.5 * x[2], 1))
    return dr.quat_to_matrix(mi.Matrix3f, q), mi.Vector3f(*x[3:])


def transform(motion: mi.Float) -> mi.Transform4f:
    """The rigid motion of `moved_pose`, under AD."""
    rotation, translation = rotation_of(motion)
    rows = [x for i in range(3) for x in (*(rotation[i, j] for j in range(3)), mi.Float(0))]
    turned = mi.Transform4f(mi.Matrix4f(*rows, 0, 0, 0, 1))
    centre = mi.Vector3f(CENTRE)
    return mi.Transform4f().translate(centre + translation) @ turned @ mi.Transform4f().translate(-centre)


def require_slopes(total: Any, define: Any, at: np.ndarray, tolerance: float = 2e-3) -> None:
    """The gradient of `total`, and its forward derivative, are the differences of `define` at (K,) values."""
    exact = at.astype(np.float64)
    sides = [[define(exact + sign * STEP * axis) for sign in (1, -1)] for axis in np.eye(len(at))]
    expected = np.array([(above - below) / (2 * STEP) for above, below in sides])
    largest = np.abs(expected).max()
    leaf = with_grad(mi.Float(at))
    dr.backward(total(leaf))
    np.testing.assert_allclose(np.array(dr.grad(leaf)), expected, atol=tolerance * largest)
    tangent = np.resize(np.array([0.5, -1, 0.7, 0.3, 1, -0.4], np.float32), len(at))
    found = dr.forward_to(total(with_grad(mi.Float(at), mi.Float(tangent))))
    assert abs(float(found[0]) - expected @ tangent) < 2 * tolerance * largest
