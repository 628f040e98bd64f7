"""The region of interest of a data set: from what its cameras look at, or from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_refgs.contraction import Region as Region
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


def region_pixels(view: View, region: Region) -> np.ndarray:
    """Pixels (H, W) whose ray, through their centre, meets the region's sphere in front of the camera."""
    across = (view.cx - 0.5 - np.arange(view.width)) / view.fx
    up = (view.cy - 0.5 - np.arange(view.height)) / view.fy
    local = np.stack([*np.meshgrid(across, up), np.ones((view.height, view.width))], axis=-1)
    toward = (np.array(region.centre) - view.to_world[:3, 3]) @ view.to_world[:3, :3]
    length = np.linalg.norm(local, axis=-1)
    along = (local @ toward) / length
    beside = np.sum(toward**2) - along**2
    inside = float(np.sum(toward**2)) < region.radius**2
    return (beside <= region.radius**2) & ((along > 0) | inside)


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
