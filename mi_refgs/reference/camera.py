"""A pinhole camera and its pose, in float64 or complex numbers, in Mitsuba's frame: +z forward, +y up."""

from dataclasses import dataclass

import numpy as np

Array = np.ndarray
QUATERNION_FLOOR = 1e-12  # largest |component| of a quaternion that is the identity, with gradient 0


@dataclass(frozen=True)
class PinholeCamera:
    """Fields of `splat.camera.Camera` in float64."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    to_world: Array  # (4, 4)
    near: float = 0.01
    film: tuple[tuple[float, float], tuple[float, float]] | None = None  # borders along x and y; None: all
    fine: bool = False


def camera_frame(raw: dict[str, Array], camera: PinholeCamera) -> tuple[Array, Array]:
    """Centres (N, 3) and axes (N, 3, 3) — t_u, t_v, n — in the camera's frame."""
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    centre = (raw["position"] - origin) @ to_camera.T
    return centre, np.stack([axis @ to_camera.T for axis in rotation_axes(raw["rotation"])], axis=1)


def rotation_axes(rotation: Array) -> tuple[Array, Array, Array]:
    """Images (N, 3) of the three axes under quaternions (x, y, z, w) of any norm."""
    largest = np.abs(rotation.real).max(axis=1, keepdims=True, initial=0)
    valid = largest >= QUATERNION_FLOOR
    q = np.where(valid, rotation / np.where(valid, largest, 1), np.array([0, 0, 0, 1.0]))
    x, y, z, w = (q / np.sqrt(np.sum(q**2, axis=1, keepdims=True))).T
    return (
        np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w)], axis=1),
        np.stack([2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w)], axis=1),
        np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1),
    )


def intrinsics(camera: PinholeCamera) -> tuple[tuple[float, float], tuple[float, float]]:
    """Focal length and centre along x, and along y."""
    return (camera.fx, camera.cx), (camera.fy, camera.cy)


def ray_slopes(camera: PinholeCamera, x: Array, y: Array) -> Array:
    """Directions (3, P) through pixels, 1 along the viewing axis."""
    return np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)])


def sigmoid(x: Array) -> Array:
    return 1 / (1 + np.exp(-x))


def look_at(origin: Array, target: Array, up: tuple[float, ...] = (0.0, 0.0, 1.0)) -> Array:
    """World-from-camera (4, 4), +z towards the target; world y is up where the view runs along `up`."""
    origin, target, upward = (np.asarray(x, dtype=np.float64) for x in (origin, target, up))
    forward = (target - origin) / np.linalg.norm(target - origin)
    if abs(forward @ upward) >= 0.95 * np.linalg.norm(upward):  # nearly parallel
        upward = np.array([0.0, 1, 0])
    left = np.cross(upward, forward)
    left /= np.linalg.norm(left)
    matrix = np.eye(4)
    matrix[:3] = np.stack([left, np.cross(forward, left), forward, origin], axis=1)
    return matrix
