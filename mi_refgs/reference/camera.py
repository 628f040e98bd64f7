"""Poses of cameras in Mitsuba's frame: +z forward, +x left, +y up."""

from __future__ import annotations

import numpy as np

PARALLEL = 0.95
"""|cos| between the view and `up` above which another direction is taken for up."""


def look_at(origin: np.ndarray, target: np.ndarray, up: tuple[float, ...] = (0.0, 0.0, 1.0)) -> np.ndarray:
    """World-from-camera (4, 4), +z towards the target; world y is up where the view runs along `up`."""
    origin, target, upward = (np.asarray(x, dtype=np.float64) for x in (origin, target, up))
    forward = (target - origin) / np.linalg.norm(target - origin)
    if abs(forward @ upward) >= PARALLEL * np.linalg.norm(upward):
        upward = np.array([0.0, 1, 0])
    left = np.cross(upward, forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    return matrix
