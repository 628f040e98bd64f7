"""Viewing poses, and their conversion to cameras of viser, of the renderer, of a data set, and of a file."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.data.poses import MITSUBA_FROM_OPENCV, MITSUBA_FROM_OPENGL, pinhole
from mi_refgs.data.view import View
from mi_refgs.splat.camera import Camera


@dataclass(frozen=True, eq=False)
class Pose:
    """A pinhole camera without pixels."""

    to_world: np.ndarray  # (4, 4) float64, rigid, from Mitsuba's camera frame: +z forward, +x left, +y up
    fov: float  # vertical, radians
    aspect: float  # width over height of the image
    near: float = 0.0  # depth of the near plane, scene units

    @staticmethod
    def of_page(camera: Any, near: float = 0.0) -> "Pose":
        """Convert a camera of viser, whose axes are OpenCV's."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_quat(np.roll(np.asarray(camera.wxyz, np.float64), -1)).as_matrix()
        matrix[:3, 3] = camera.position
        aspect = max(camera.image_width, 1) / max(camera.image_height, 1)
        return Pose(matrix @ MITSUBA_FROM_OPENCV, float(camera.fov), aspect, near)

    @staticmethod
    def of_view(view: View) -> "Pose":
        """Convert an image's camera, without its principal point, which a page cannot represent."""
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
    def page_rotation(self) -> np.ndarray:
        """Unit quaternion (4,), w first, of viser's axes, which are OpenCV's."""
        return np.roll(Rotation.from_matrix((self.to_world @ MITSUBA_FROM_OPENCV)[:3, :3]).as_quat(), 1)

    def look_at(self, centre: np.ndarray) -> np.ndarray:
        """Return the point (3,) of the viewing axis, in front of the camera, that is nearest to a centre."""
        along = float((centre - self.position) @ self.forward)
        return self.position + max(along, 1e-3 * float(np.linalg.norm(centre - self.position))) * self.forward

    def camera(self, width: int, height: int, offset: tuple[float, float] = (0.0, 0.0)) -> Camera:
        """Return the renderer's camera with samples `offset` pixels off the pixel centres."""
        slope = math.tan(self.fov / 2)
        fx, fy = width / 2 / (slope * self.aspect), height / 2 / slope
        cx, cy = width / 2 - offset[0], height / 2 - offset[1]
        return Camera.from_pose(width, height, -fx, -fy, cx, cy, self.to_world, self.near)

    def transforms(self, width: int, height: int, image: str) -> dict[str, Any]:
        """Return the content of a transforms file of one frame, of an image with this name and size."""
        focal = height / 2 / math.tan(self.fov / 2)
        matrix = (self.to_world @ MITSUBA_FROM_OPENGL).tolist()
        frames = [{"file_path": f"./{image}", "transform_matrix": matrix}]
        near = {"near": self.near} if self.near else {}
        return {**pinhole(width, height, focal), **near, "frames": frames}


def up_of(views: list[View]) -> np.ndarray:
    """Return the unit up direction (3,) of a data set: z, unless its cameras agree on one 20° from it."""
    z = np.array([0.0, 0.0, 1.0])
    mean = np.mean([view.to_world[:3, 1] for view in views], axis=0) if views else z
    length = float(np.linalg.norm(mean))
    return z if length < 0.5 or mean[2] / length > math.cos(math.radians(20)) else np.asarray(mean / length)
