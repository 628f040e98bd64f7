"""The region of interest: a sphere, the contraction of space around it, and its estimate from cameras.

The contraction maps all of space into a ball of twice the sphere's radius, so that a grid or random samples
in contracted space cover near and far. World positions in scene units. [Mip-NeRF 360, Barron et al. 2022,
eq. 10]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.hull import view_focus
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_json

REGION_FILE = "region.json"
"""File in the folder of a data set: {"centre": [x, y, z], "radius": r} in scene units."""
REGION_SHARE = 0.8
"""Radius of the region estimated from cameras over that of the sphere that the median view shows entirely."""
CAMERA_SHARE = 0.8  # its largest radius over the nearest camera's distance: cameras are outside of the region
SMALLEST = 1e-6
"""Its smallest radius over the largest coordinate of a camera: float32 resolves no smaller lengths."""


@dataclass(frozen=True)
class Region:
    """A sphere."""

    centre: tuple[float, float, float]  # world
    radius: float  # scene units, positive

    @staticmethod
    def of(content: Any, source: Path | str) -> Region:
        """The region {"centre": [x, y, z], "radius": r} of a JSON file or an option, `source`.

        Raises InputError for anything else, and for numbers that no scene has.
        """
        centre = content.get("centre") if isinstance(content, dict) else None
        numbers = [*centre, content.get("radius")] if isinstance(centre, list) else []
        usable = all(type(number) in (int, float) and abs(number) <= MAX_NUMBER for number in numbers)
        if len(numbers) != 4 or not usable or not numbers[3] >= 1 / MAX_NUMBER:
            raise InputError(
                f"{source}: centre, radius: not three numbers and a positive one; correct or remove them"
            )
        x, y, z, radius = map(float, numbers)
        return Region((x, y, z), radius)

    def moved(self, offset: np.ndarray) -> Region:
        """The region with its centre moved by an offset (3,)."""
        x, y, z = (float(c) for c in np.array(self.centre) + offset)
        return Region((x, y, z), self.radius)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 3) are inside: (N,) bool."""
        return np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius

    def contract(self, points: np.ndarray) -> np.ndarray:
        """Contract world points (N, 3): o = offset / radius inside the sphere, (2 − 1/|o|) o/|o| outside."""
        offset = (np.asarray(points, dtype=np.float64) - np.array(self.centre)) / self.radius
        length = np.linalg.norm(offset, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        return np.where(length > 1, (2 - 1 / safe) * offset / safe, offset)

    def expand(self, contracted: np.ndarray) -> np.ndarray:
        """Inverse of `contract` for points (N, 3) of length below 2."""
        contracted = np.asarray(contracted, dtype=np.float64)
        length = np.linalg.norm(contracted, axis=-1, keepdims=True)
        safe = np.maximum(length, 1.0)
        offset = np.where(length > 1, contracted / (safe * (2 - safe)), contracted)
        return np.array(self.centre) + self.radius * offset


def region_of(views: Sequence[View]) -> Region:
    """The sphere around the point that all cameras look at, as large as the median view shows entirely.

    Raises InputError if the view axes have no common point (one view, or parallel ones), if that point is
    behind half of the cameras (they look outward), and if a camera is at that point.
    """
    focus, distance = view_focus(views)
    origins = np.array([view.to_world[:3, 3] for view in views])
    ahead = [float((focus - view.to_world[:3, 3]) @ view.to_world[:3, 2]) > 0 for view in views]
    half_angle = np.array([np.arctan(min(v.width / v.fx, v.height / v.fy) / 2) for v in views])
    radius = region_radius(distance, half_angle)
    if 2 * sum(ahead) <= len(views) or not radius > SMALLEST * float(np.abs(origins).max()):
        raise InputError("views: cameras: they do not look at one point in front of them; give a region.json")
    x, y, z = (float(c) for c in focus)
    return Region((x, y, z), radius)


def region_radius(distance: np.ndarray, half_angle: np.ndarray) -> float:
    """The radius for cameras at distances (V,) from the centre; half angles of view (V,) in radians."""
    entire = float(np.median(distance * np.sin(half_angle)))
    return min(REGION_SHARE * entire, CAMERA_SHARE * float(distance.min()))


def weighted_quantile(values: np.ndarray, weight: np.ndarray, share: float) -> float:
    """The value below which `share` of the weight lies."""
    order = np.argsort(values)
    summed = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(summed, share * summed[-1])])


def region_pixels(view: View, region: Region) -> np.ndarray:
    """Mask (H, W) of pixels whose ray through the centre hits the region's sphere in front of the camera."""
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
    """Read region.json of a data set's folder; None without the file.

    Raises InputError for a file that cannot be used.
    """
    path = folder / REGION_FILE
    return Region.of(read_json(path), path) if path.is_file() else None


def write_region(folder: Path, region: Region) -> None:
    """Write region.json into a data set's folder; raises InputError if it cannot be written."""
    write_json(folder / REGION_FILE, {"centre": list(region.centre), "radius": region.radius})
