"""Conversion of other programs' cameras to Mitsuba's camera frame: +z forward, +x left, +y up."""

import math
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER, RIGID_TOLERANCE
from mi_refgs.errors import InputError

EXACT, ROUNDED = 1e-4, 0.02  # |RᵀR - 1| of rotations with 5 digits, and with 2 or 3
MITSUBA_FROM_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])  # −z forward, +x right, +y up; its own inverse
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])  # +z forward, +x right, +y down; its own inverse


def poses_around(outward: np.ndarray, centre: np.ndarray, distance: float | np.ndarray) -> np.ndarray:
    """World-from-camera matrices (N, 4, 4) in Mitsuba's frame, z up, of cameras that look at `centre` from
    unit directions `outward` (N, 3), none of them ±z; `distance` is a number or (N, 1)."""
    left = np.cross([0.0, 0.0, 1.0], -outward)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    up = np.cross(-outward, left)
    poses = np.tile(np.eye(4), (len(outward), 1, 1))
    poses[:, :3, :] = np.stack([left, up, -outward, centre + distance * outward], axis=2)
    return poses


def pinhole(width: int, height: int, focal: float) -> dict[str, Any]:
    """Intrinsics for a transforms file: square pixels, principal point at the centre; lengths in pixels."""
    centre = {"cx": width / 2, "cy": height / 2}
    angle = 2 * math.atan(0.5 * width / focal)
    return {"camera_angle_x": angle, "w": width, "h": height, "fl_x": focal, "fl_y": focal, **centre}


def rigid(matrix: np.ndarray, field: str) -> np.ndarray:
    """Return a (4, 4) matrix, its rotation made orthonormal if it is rounded or its axes are scaled; raises
    InputError, starting with `field`, unless that is rigid."""
    with np.errstate(all="ignore"):  # any numbers
        axes = matrix[:3, :3] / np.linalg.norm(matrix[:3, :3], axis=0)
        fine = (
            np.abs(matrix).max() <= MAX_NUMBER
            and np.abs(axes.T @ axes - np.eye(3)).max() < ROUNDED
            and np.linalg.det(axes) > 0
            and np.abs(matrix[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE
        )
    if not fine:
        raise InputError("not a rotation and a translation", field, None, "remove shear and mirroring")
    if np.abs(matrix[:3, :3].T @ matrix[:3, :3] - np.eye(3)).max() < EXACT:
        return matrix
    left, _, right = np.linalg.svd(axes)
    return np.block([[left @ right, matrix[:3, 3:]], [matrix[3:]]])


def from_world_to_camera(rotation: np.ndarray, translation: np.ndarray, field: str) -> np.ndarray:
    """`View.to_world` of a camera with OpenCV's axes in which a world point x is at R x + t; as `rigid`."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    return np.linalg.inv(rigid(matrix, field)) @ MITSUBA_FROM_OPENCV
