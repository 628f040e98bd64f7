"""Derivatives with respect to rigid motions of what a whole image depends on: cameras and environments.

A motion is an array of zeros under AD: a rotation (3,), radians about world axes, and more numbers. Scale and
shear of a matrix have no derivative."""

from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.types import Float, Vector3f


def motion_of(matrix: Any, *more: Float) -> Float:
    """The motion of a rotation matrix and of further numbers, all of width 1 under AD. A tangent of the
    matrix counts by its antisymmetric part, which is that of the nearest rotation."""
    turned = matrix @ dr.rcp(dr.detach(matrix))
    angles = [0.5 * (turned[i, j] - turned[j, i]) for i, j in ((2, 1), (0, 2), (1, 0))]
    motion = dr.concat([*angles, *more])
    return motion - dr.detach(motion)


def rotation_part(matrix: Any) -> Any:  # mi.Matrix4f → mi.Matrix3f, under AD
    return mi.Matrix3f(*(matrix[i, j] for i in range(3) for j in range(3)))


def part_of(motion: Float, first: int, vector: Vector3f) -> Vector3f:
    """Three numbers of a motion per vector, gathered: the adjoint of a broadcast is a kernel per use."""
    index = dr.full(mi.UInt32, first, dr.width(vector))
    return mi.Vector3f(*(dr.gather(mi.Float, motion, index + i, mode=dr.ReduceMode.Expand) for i in range(3)))


def turned_by(motion: Float | None, vector: Vector3f, sign: int = 1) -> Vector3f:
    """Vectors, rotated by the motion, or by its inverse if `sign` is -1."""
    return vector if motion is None else vector + sign * dr.cross(part_of(motion, 0, vector), vector)
