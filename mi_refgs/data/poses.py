"""Conversion of other programs' cameras to Mitsuba's camera frame: +z forward, +x left, +y up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER, RIGID_TOLERANCE
from mi_refgs.errors import InputError

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
    """Return a (4, 4) matrix; raises InputError, starting with `field`, unless it is rigid."""
    rotation = matrix[:3, :3]
    with np.errstate(all="ignore"):  # any numbers
        fine = (
            np.abs(matrix).max() <= MAX_NUMBER
            and np.abs(rotation.T @ rotation - np.eye(3)).max() < RIGID_TOLERANCE
            and np.linalg.det(rotation) > 0
            and np.abs(matrix[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE
        )
    if not fine:
        raise InputError("not a rotation and a translation", field, None, "remove scale, shear and mirroring")
    return matrix


def from_world_to_camera(rotation: np.ndarray, translation: np.ndarray, field: str) -> np.ndarray:
    """`View.to_world` of a camera with OpenCV's axes in which a world point x is at R x + t; as `rigid`."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    rigid(matrix, field)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
    return matrix @ MITSUBA_FROM_OPENCV
