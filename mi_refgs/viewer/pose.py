"""Where a page looks from: cameras of viser, of the renderer, of a data set, and of a file."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.data.poses import MITSUBA_FROM_OPENCV, MITSUBA_FROM_OPENGL, pinhole
from mi_refgs.data.view import View
from mi_refgs.splat.camera import Camera

UP_TOLERANCE = math.cos(math.radians(20))
"""Cosine up to which the cameras' mean up direction counts as z."""


@dataclass(frozen=True, eq=False)
class Pose:
    """A pinhole camera without pixels."""

    to_world: np.ndarray  # (4, 4) float64, rigid, from Mitsuba's camera frame: +z forward, +x left, +y up
    fov: float  # vertical, radians
    aspect: float  # width over height of what it sees
    near: float = 0.0  # depth of the near plane, scene units

    @staticmethod
    def of_page(wxyz: np.ndarray, position: np.ndarray, fov: float, aspect: float, near: float = 0.0) -> Pose:
        """From the numbers of a viser camera: a unit quaternion of OpenCV's axes, w first, and a position."""
        w, x, y, z = (float(c) for c in np.asarray(wxyz, np.float64) / np.linalg.norm(wxyz))
        matrix = np.eye(4)
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, 3] = position
        return Pose(matrix @ MITSUBA_FROM_OPENCV, float(fov), float(aspect), near)

    @staticmethod
    def of_view(view: View) -> Pose:
        """From a picture's camera, less what a page cannot show: a principal point beside the centre."""
        fov = 2 * math.atan(view.height / 2 / view.fy)
        return Pose(view.to_world, fov, view.width / view.fx / (view.height / view.fy), view.near)

    @property
    def position(self) -> np.ndarray:
        """World position (3,)."""
        return self.to_world[:3, 3]

    @property
    def forward(self) -> np.ndarray:
        """Unit viewing direction (3,)."""
        return self.to_world[:3, 2]

    @property
    def up(self) -> np.ndarray:
        """Unit direction (3,) of the picture's upper edge."""
        return self.to_world[:3, 1]

    def look_at(self, centre: np.ndarray) -> np.ndarray:
        """The point (3,) of the viewing axis that is nearest to a centre, in front of the camera."""
        along = float((centre - self.position) @ self.forward)
        return self.position + max(along, 1e-3 * float(np.linalg.norm(centre - self.position))) * self.forward

    def apart(self, other: Pose, distance: float) -> float:
        """How far two views differ: positions in parts of a distance, axes and fields of view in radians."""
        moved = float(np.linalg.norm(self.position - other.position)) / max(distance, 1e-9)
        return max(moved, float(np.linalg.norm(self.forward - other.forward)), abs(self.fov - other.fov))

    def camera(self, width: int, height: int, offset: tuple[float, float] = (0.0, 0.0)) -> Camera:
        """The renderer's camera of this many pixels, whose samples lie `offset` pixels off the centres."""
        slope = math.tan(self.fov / 2)
        fx, fy = width / 2 / (slope * self.aspect), height / 2 / slope
        cx, cy = width / 2 - offset[0], height / 2 - offset[1]
        return Camera.from_pose(width, height, -fx, -fy, cx, cy, self.to_world, self.near)

    def transforms(self, width: int, height: int, picture: str) -> dict[str, Any]:
        """The content of a transforms file of one frame, whose picture has this name and size."""
        focal = height / 2 / math.tan(self.fov / 2)
        matrix = (self.to_world @ MITSUBA_FROM_OPENGL).tolist()
        frames = [{"file_path": f"./{picture}", "transform_matrix": matrix}]
        near = {"near": self.near} if self.near else {}
        return {**pinhole(width, height, focal), **near, "frames": frames}


def up_of(views: list[View]) -> np.ndarray:
    """Unit up direction (3,) of a data set: z, unless its cameras agree on another one."""
    z = np.array([0.0, 0.0, 1.0])
    if not views:
        return z
    mean = np.mean([view.to_world[:3, 1] for view in views], axis=0)
    length = float(np.linalg.norm(mean))
    if length < 0.5 or mean[2] / length > UP_TOLERANCE:
        return z
    return np.asarray(mean / length)


def page_rotation(pose: Pose) -> np.ndarray:
    """The unit quaternion (4,), w first, of viser's axes, which are OpenCV's."""
    turn = Rotation.from_matrix((pose.to_world @ MITSUBA_FROM_OPENCV)[:3, :3])
    return np.roll(turn.as_quat(), 1)
