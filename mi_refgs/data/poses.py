"""Cameras of other programs in Mitsuba's frame: +z forward, +x left, +y up."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER, RIGID_TOLERANCE
from mi_refgs.errors import InputError

MITSUBA_FROM_OPENGL = np.diag([-1.0, 1.0, -1.0, 1.0])
"""OpenGL's camera looks along −z with +x right and +y up; its own inverse."""
MITSUBA_FROM_OPENCV = np.diag([-1.0, -1.0, 1.0, 1.0])
"""OpenCV's and COLMAP's looks along +z with +x right and +y down; its own inverse."""


def pinhole(width: int, height: int, focal: float) -> dict[str, Any]:
    """The lens in a transforms file: square pixels, the principal point in the middle; lengths in pixels."""
    return {
        "camera_angle_x": 2 * math.atan(0.5 * width / focal),
        "w": width,
        "h": height,
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2,
        "cy": height / 2,
    }


def rigid(matrix: np.ndarray, field: str) -> np.ndarray:
    """The (4, 4) matrix, if it is a rotation and a translation; else InputError that begins with `field`."""
    rotation = matrix[:3, :3]
    with np.errstate(all="ignore"):  # any numbers
        fine = (
            np.abs(matrix).max() <= MAX_NUMBER
            and np.abs(rotation.T @ rotation - np.eye(3)).max() < RIGID_TOLERANCE
            and np.linalg.det(rotation) > 0
            and np.abs(matrix[3] - [0, 0, 0, 1]).max() < RIGID_TOLERANCE
        )
    if not fine:
        raise InputError(f"{field}: not a rotation and a translation; remove scale, shear and mirroring")
    return matrix


def from_world_to_camera(rotation: np.ndarray, translation: np.ndarray, field: str) -> np.ndarray:
    """`View.to_world` of a camera with OpenCV's axes that sees a world point x at R x + t.

    Raises InputError that begins with `field` unless it is rigid.
    """
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, translation
    rigid(matrix, field)
    matrix[:3, :3], matrix[:3, 3] = rotation.T, -rotation.T @ translation
    return matrix @ MITSUBA_FROM_OPENCV
