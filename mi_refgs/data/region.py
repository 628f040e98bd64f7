"""The region of interest: a sphere around the object, outside of which a picture shows its surroundings.

World positions in scene units. `contract` maps all of space into a ball of twice the region's radius, so that
a grid or a random draw covers near and far at once. [Mip-NeRF 360, Barron et al. 2022, eq. 10]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_refgs.data.hull import view_focus
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.files import read_json

REGION_FILE = "region.json"
"""Beside the pictures of a data set: {"centre": [x, y, z], "radius": r} in scene units."""
REGION_SHARE = 0.8
"""Radius of the region that cameras suggest, as part of the sphere that the median view shows whole."""
CAMERA_SHARE = 0.8
"""Its largest radius as part of the nearest camera's distance: a camera stands outside of the region."""


@dataclass(frozen=True)
class Region:
    """A sphere."""

    centre: tuple[float, float, float]  # world
    radius: float  # scene units, positive

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (N, 3) lie inside: (N,) bool."""
        return np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius

    def contract(self, points: np.ndarray) -> np.ndarray:
        """World points (N, 3) in the ball of radius 2: offset / radius inside, (2 − 1/|o|) o/|o| beyond."""
        offset = (np.asarray(points, dtype=np.float64) - np.array(self.centre)) / self.radius
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        return np.where(length > 1, (2 - 1 / safe) * offset / safe, offset)

    def expand(self, contracted: np.ndarray) -> np.ndarray:
        """The inverse of `contract` for points (N, 3) of length below 2."""
        contracted = np.asarray(contracted, dtype=np.float64)
        length = np.linalg.norm(contracted, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        offset = np.where(length > 1, contracted / (safe * (2 - safe)), contracted)
        return np.array(self.centre) + self.radius * offset


def region_of(views: Sequence[View]) -> Region:
    """The sphere around what all cameras look at, as large as the median view shows whole.

    Raises InputError if the view axes have no common point (one view, or parallel ones).
    """
    focus, distance = view_focus(views)
    half_angle = np.array([np.arctan(min(v.width / v.fx, v.height / v.fy) / 2) for v in views])
    whole = float(np.median(distance * np.sin(half_angle)))
    radius = min(REGION_SHARE * whole, CAMERA_SHARE * float(distance.min()))
    x, y, z = (float(c) for c in focus)
    return Region((x, y, z), radius)


def read_region(folder: Path) -> Region | None:
    """The region that a data set's folder records; None without the file, InputError for one of no use."""
    path = folder / REGION_FILE
    if not path.is_file():
        return None
    content = read_json(path)
    try:
        centre = np.array(content["centre"], dtype=np.float64)
        radius = float(content["radius"])
    except (KeyError, TypeError, ValueError, OverflowError):
        centre, radius = np.empty(0), 0.0
    if centre.shape != (3,) or not np.isfinite(centre).all() or not 0 < radius < np.inf:
        raise InputError(
            f"{path}: centre, radius: not three numbers and a positive one; correct them, or remove the file"
        )
    x, y, z = (float(c) for c in centre)
    return Region((x, y, z), radius)
