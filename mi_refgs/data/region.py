"""The region of interest: a sphere above planes that support the object, such as a table or a wall. The
contraction maps all of space into a ball of twice the sphere's radius, so that random samples in contracted
space cover near and far. [Mip-NeRF 360, Barron et al. 2022, eq. 10]"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.hull import view_focus
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json, write_json

REGION_FILE = "region.json"  # in the folder of a data set: the `content` of its region
REGION_SHARE = 0.8  # radius estimated from cameras over that of the sphere that the median view shows whole
CAMERA_SHARE = 0.8  # its largest radius over the nearest camera's distance: cameras are outside of the region
SAME = 1e-6  # difference of two regions, in radii, up to which they are the same: last digits of solvers
SMALLEST = 1e-6  # least radius over the largest coordinate of a camera: float32 resolves no smaller lengths

Plane = tuple[float, ...]  # unit normal (a, b, c) and offset d of a x + b y + c z ≥ d


@dataclass(frozen=True)
class Region:
    """A sphere, or the part of it that is above planes."""

    centre: tuple[float, ...]  # (3,) world
    radius: float  # scene units, positive
    planes: tuple[Plane, ...] = ()
    estimated: bool = field(default=False, compare=False)  # from cameras and points, not given by a user

    @staticmethod
    def of(content: object, source: Path | str) -> Region:
        """The region {"centre": [x, y, z], "radius": r, "planes": [[a, b, c, d], …]} of a JSON file or an
        option, `source`; planes are optional. Raises InputError for anything else."""
        given: dict[str, Any] = content if isinstance(content, dict) else {}
        centre, remedy = _numbers(given.get("centre"), 3), "correct or remove them"
        radius = _numbers([given.get("radius")], 1)
        if centre is None or radius is None or not radius[0] >= 1 / MAX_NUMBER:
            raise InputError("not three numbers and a positive one", source, "centre, radius", remedy)
        planes, rows = list[Plane](), given.get("planes", [])
        for row in rows if isinstance(rows, list) else [rows]:
            plane = _numbers(row, 4)
            length = 0.0 if plane is None else float(np.linalg.norm(plane[:3]))
            if plane is None or not length >= 1 / MAX_NUMBER:
                raise InputError("not [a, b, c, d] of a x + b y + c z ≥ d each", source, "planes", remedy)
            planes.append(tuple(number / length for number in plane))
        return Region(tuple(centre), radius[0], tuple(planes), given.get("estimated") is True)

    @property
    def content(self) -> dict[str, Any]:
        """What `of` reads."""
        found: dict[str, Any] = {"centre": list(self.centre), "radius": self.radius}
        found |= {"planes": [list(plane) for plane in self.planes]} if self.planes else {}
        return found | ({"estimated": True} if self.estimated else {})

    @property
    def supports(self) -> tuple[Plane, ...]:
        """The planes without those around a fitted object: at the end, three opposite pairs or more."""
        normals = np.array(self.planes).reshape(-1, 4)[:, :3]
        for pairs in range(len(normals) // 2, 2, -1):
            first, second = normals[-2 * pairs : -pairs], normals[-pairs:]
            if np.abs(first + second).max() < SAME:
                return self.planes[: -2 * pairs]
        return self.planes

    def moved(self, offset: np.ndarray) -> Region:
        planes = tuple((a, b, c, d + float(np.dot((a, b, c), offset))) for a, b, c, d in self.planes)
        return replace(self, centre=tuple(map(float, np.add(self.centre, offset))), planes=planes)

    def is_close(self, other: Region) -> bool:
        """Whether two regions are the same but for the last digits."""
        own, others = ((*r.centre, r.radius, *np.ravel(r.planes)) for r in (self, other))
        return len(own) == len(others) and bool(np.allclose(own, others, rtol=0, atol=SAME * self.radius))

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Heights (N, P) of points (N, 3) above the planes, scene units."""
        planes = np.array(self.planes).reshape(-1, 4)
        return np.asarray(points @ planes[:, :3].T - planes[:, 3])

    def above(self, points: np.ndarray, height: float = 0.0) -> np.ndarray:
        """Whether points (N, 3) are above all planes by this height, scene units: (N,) bool."""
        return np.asarray((self.heights(points) >= height).all(axis=-1))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether points (N, 3) are inside: (N,) bool."""
        near = np.linalg.norm(points - np.array(self.centre), axis=-1) <= self.radius
        return np.asarray(near & self.above(points))

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


def _numbers(value: object, count: int) -> list[float] | None:
    """A list of so many numbers that a scene may have; None for anything else."""
    if not isinstance(value, list) or len(value) != count:
        return None
    usable = all(type(number) in (int, float) and abs(number) <= MAX_NUMBER for number in value)
    return [float(number) for number in value] if usable else None


def region_of(views: Sequence[View]) -> Region:
    """The sphere around the point that all cameras look at, as large as the median view shows entirely.
    Raises InputError if there is no such point, if it is behind half of the cameras, and if one is there."""
    focus, distance = view_focus(views)
    origins = np.array([view.to_world[:3, 3] for view in views])
    ahead = [float(view.depth_of(focus)) > 0 for view in views]
    half_angle = np.array([np.arctan(min(v.width / v.fx, v.height / v.fy) / 2) for v in views])
    radius = region_radius(distance, half_angle)
    if 2 * sum(ahead) <= len(views) or not radius > SMALLEST * float(np.abs(origins).max()):
        what = "they do not look at one point in front of them"
        raise InputError(what, "views", "cameras", "give a region.json")
    return Region(tuple(map(float, focus)), radius, estimated=True)


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
    """Mask (H, W) of pixels whose ray through the centre hits the region in front of the camera."""
    across = (view.cx - 0.5 - np.arange(view.width)) / view.fx
    up = (view.cy - 0.5 - np.arange(view.height)) / view.fy
    local = np.stack([*np.meshgrid(across, up), np.ones((view.height, view.width))], axis=-1)
    rotation, origin = view.to_world[:3, :3], view.to_world[:3, 3]
    toward = (np.array(region.centre) - origin) @ rotation
    length = np.linalg.norm(local, axis=-1)
    along = (local @ toward) / length
    beside = np.sum(toward**2) - along**2
    # The part of each ray in the sphere and above the planes, where its height grows or falls linearly.
    half = np.sqrt(np.maximum(region.radius**2 - beside, 0))
    first, last = np.maximum(along - half, 0), along + half
    for *normal, offset in region.planes:
        height, slope = origin @ normal - offset, (local @ (normal @ rotation)) / length
        crossing = -height / np.where(slope == 0, np.inf, slope)
        first = np.where(slope > 0, np.maximum(first, crossing), first)
        last = np.where(slope < 0, np.minimum(last, crossing), last)
        last = np.where((slope == 0) & (height < 0), -1, last)
    return (beside <= region.radius**2) & (first <= last)


def read_region(folder: Path) -> Region | None:
    """The region in region.json of a data set's folder; None without the file."""
    path = folder / REGION_FILE
    return Region.of(read_json(path), path) if path.is_file() else None


def write_region(folder: Path, region: Region) -> None:
    write_json(folder / REGION_FILE, region.content)
