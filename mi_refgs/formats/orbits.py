"""Cameras around a scene: on a sphere where there is no data set, on a circle for a turntable."""

import math
from collections.abc import Mapping, Sequence

import numpy as np

from mi_refgs.constants import GOLDEN_ANGLE
from mi_refgs.data.poses import poses_around
from mi_refgs.data.region import Region, weighted_quantile
from mi_refgs.errors import InputError
from mi_refgs.formats.format import Shot
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import sigmoid
from mi_refgs.surfels.table import Surfels

CAMERAS = {"test": 4, "train": 60}  # cameras around an object without a data set
SIZE, FIELD_OF_VIEW = 512, 40.0  # pixels and degrees of their square images
ELEVATION = (-10.0, 70.0)  # degrees
INSIDE = 0.98  # fraction of the surfels, by opacity, in the sphere that fills these images; others are strays
SIGMAS = 2.0  # standard deviations around its centre up to which a surfel is in that sphere


def sphere_around(surfels: Surfels) -> tuple[np.ndarray, float]:
    """Return centre (3,) and radius of a sphere around the surfels without strays (INSIDE)."""
    position, weight = _weighted(surfels)
    middle = _middle(position, weight)
    deviation = surfels.primitive.extent(surfels.to_numpy())[1].max(axis=1)
    far = np.linalg.norm(position - middle, axis=1) + SIGMAS * deviation
    return middle, max(weighted_quantile(far, weight, INSIDE), 1e-6)


def shots_around(
    surfels: Surfels,
    counts: Mapping[str, int] = CAMERAS,  # by split
    size: int = SIZE,  # pixels per side
    elevation: tuple[float, float] = ELEVATION,  # degrees
) -> list[Shot]:
    """Cameras around `sphere_around` the surfels, z up, spread within each split."""
    middle, radius = sphere_around(surfels)
    distance = 1.1 * radius / math.sin(math.radians(FIELD_OF_VIEW / 2))
    focal = size / 2 / math.tan(math.radians(FIELD_OF_VIEW / 2))
    shots = []
    for split, count in counts.items():
        low, high = (math.sin(math.radians(e)) for e in elevation)
        order = (np.arange(count) + count // 2) % count
        up = low + (high - low) * (order + 0.5) / count
        turn = GOLDEN_ANGLE * order
        ring = np.sqrt(1 - up**2)
        outward = np.stack([ring * np.cos(turn), ring * np.sin(turn), up], axis=1)
        for i, pose in enumerate(poses_around(outward, middle, distance)):
            camera = Camera.from_pose(size, size, -focal, -focal, size / 2, size / 2, pose, 1e-2 * distance)
            shots.append(Shot(f"{split}/r_{i:03d}", split, camera))
    return shots


def turntable_cameras(
    scene: TrainedScene, cameras: Sequence[Camera], count: int, region: Region | None = None
) -> list[Camera]:
    """Cameras on a circle around the object, z up, with the median distance and height of `cameras`, and the
    first one's lens. Without a `region`, the object is the box of INSIDE of the surfels, or of the mesh."""
    position, weight = _weighted(scene.surfels)
    if scene.mesh is not None:
        position, weight = scene.mesh.vertices.astype(np.float64), np.ones(len(scene.mesh.vertices))
    centre = _middle(position, weight) if region is None else np.array(region.centre)
    offset = np.array([camera.pose()[:3, 3] for camera in cameras]) - centre
    length = np.linalg.norm(offset, axis=1)
    distance, height = float(np.median(length)), float(np.median(offset[:, 2] / length))
    height = min(max(height, -0.95), 0.95)  # not from a pole, where no side is up
    angle = 2 * np.pi * np.arange(count) / count
    ring = math.sqrt(1 - height**2)
    outward = np.stack([ring * np.cos(angle), ring * np.sin(angle), np.full(count, height)], axis=1)
    return [cameras[0].moved(pose) for pose in poses_around(outward, centre, distance)]


def _middle(position: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the centre (3,) of the box between the quantiles 1 - INSIDE and INSIDE along each axis."""
    ends = [[weighted_quantile(axis, weight, share) for axis in position.T] for share in (1 - INSIDE, INSIDE)]
    return np.mean(ends, axis=0)


def _weighted(surfels: Surfels) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3) and opacities (N,), float64; raises InputError where there are none."""
    raw = surfels.to_numpy()
    if not len(raw["position"]):
        raise InputError("there are none", "surfels", remedy="cameras have nothing to look at")
    return raw["position"].astype(np.float64), sigmoid(raw["opacity"][:, 0].astype(np.float64))
