"""What is splatted: random surfels on a sphere, or those of a fitted scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.reference.camera import look_at
from mi_refgs.reference.splat import PinholeCamera
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.init import quaternions
from mi_refgs.surfels.primitives.surfel import Surfel
from mi_refgs.surfels.table import Surfels

OPACITY = 0.8
DISTANCE = 4.0
FIELD_OF_VIEW = 40.0  # degrees
DIRECTION = (0.6, 0.8, 0.0)
"""From the sphere's centre to the camera."""
CHANNELS = {"normal": 3, "albedo": 3, "metallic": 1, "roughness": 1, "radiance": 3, "indirect light": 3}
"""Features of the full G-buffer; with depth and alpha they are its 16 channels."""
FEATURES = sum(CHANNELS.values())
COLOUR = 3


@dataclass(frozen=True, eq=False)
class Workload:
    """Surfels, what they carry, and the camera."""

    name: str
    spread: float | None
    raw: dict[str, np.ndarray]  # raw channels (N, D), float32
    features: np.ndarray  # (N, FEATURES) float32
    pinhole: PinholeCamera

    @property
    def count(self) -> int:
        """Number of surfels."""
        return len(self.features)

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.pinhole.width * self.pinhole.height

    def surfels(self) -> Surfels:
        """On the device."""
        return Surfels.from_numpy(self.raw)

    def columns(self, features: int = FEATURES) -> list[Any]:
        """The first features, on the device."""
        return [mi.Float(np.ascontiguousarray(column)) for column in self.features.T[:features]]

    def camera(self) -> Camera:
        """The splatter's."""
        return device_camera(self.pinhole)

    def weights(self, maps: int) -> np.ndarray:
        """Adjoints (maps, H·W) float32 of the maps: what a loss would send back."""
        rng = np.random.default_rng(1)
        return rng.normal(size=(maps, self.pixels)).astype(np.float32)


def device_camera(p: PinholeCamera) -> Camera:
    """The splatter's camera of the oracle's."""
    return Camera.from_pose(p.width, p.height, p.fx, p.fy, p.cx, p.cy, p.to_world, p.near)


def sphere(count: int, size: int, spread: float) -> Workload:
    """Surfels that touch the unit sphere at random points, std = spread · √(4π/N), seen from outside."""
    rng = np.random.default_rng([count, 7])
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    std = spread * np.sqrt(4 * np.pi / count)
    raw = {
        "position": normal,
        "rotation": quaternions(normal, count, rng),
        "scale": np.full((count, 2), np.log(std)),
        "opacity": np.full((count, 1), logit(OPACITY)),
    }
    focal = -0.5 * size / np.tan(np.radians(FIELD_OF_VIEW / 2))
    to_world = look_at(DISTANCE * np.array(DIRECTION), np.zeros(3))
    return Workload(
        "sphere",
        spread,
        {name: values.astype(np.float32) for name, values in raw.items()},
        rng.uniform(size=(count, FEATURES)).astype(np.float32),
        PinholeCamera(size, size, focal, focal, size / 2, size / 2, to_world),
    )


def fitted(folder: str) -> Workload:
    """The surfels of a run folder in its first test camera, with random features."""
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.runs.run import Run

    run = Run(folder)
    state = run.load_checkpoint()
    view = load_split(run, run.method(), "test").views[0]
    if state is None:
        raise InputError(f"{folder}: checkpoints: none; train it first")
    raw = {name: np.asarray(state[f"params/{name}"], np.float32) for name in Surfel.widths}
    count = len(raw["position"])
    features = np.random.default_rng(7).uniform(size=(count, FEATURES)).astype(np.float32)
    pinhole = PinholeCamera(view.width, view.height, -view.fx, -view.fy, view.cx, view.cy, view.to_world)
    return Workload(Path(folder).name, None, raw, features, pinhole)
