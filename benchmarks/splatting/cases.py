"""Settings of a run, and the scenes that are splatted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.reference.camera import look_at
from mi_refgs.reference.splat import PinholeCamera
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.init import quaternions
from mi_refgs.surfels.table import Surfels

Grid = tuple[tuple[int, int], ...]  # (surfels, edge of the image in pixels)


@dataclass(frozen=True)
class Settings:
    """One run; `spreads` are the standard deviations of surfels in units of √(sphere's area / surfels)."""

    surfels: tuple[int, ...] = (1_000, 10_000, 50_000, 200_000)
    sizes: tuple[int, ...] = (128, 256, 512, 1024)
    spreads: tuple[float, ...] = (0.75, 1.5)
    repeats: int = 9  # of each of our times; at least three of a slow one
    seconds: float = 2.5  # spent on ours in one case, roughly
    volprim: Grid = (
        *((n, size) for n in (1_000, 10_000, 50_000, 200_000) for size in (128, 256)),
        (50_000, 512),
    )
    volprim_repeats: int = 2
    errors: Grid = ((1_000, 256), (10_000, 256), (50_000, 256), (50_000, 512))
    crop: int = 32  # pixels, edge of the part whose error is measured
    step: tuple[int, int] = (20_000, 200)  # of the training step
    steps: int = 30
    large_step: tuple[int, int] = (1_000_000, 1024)  # memory of one training step


PAGE = Settings()
SMALL = Settings(
    surfels=(200, 2_000),
    sizes=(32, 64),
    spreads=(1.5,),
    repeats=3,
    seconds=0.1,
    volprim=((200, 32),),
    volprim_repeats=1,
    errors=((200, 32), (2_000, 64)),
    crop=16,
    step=(500, 32),
    steps=3,
    large_step=(500, 32),
)


OPACITY = 0.8
DISTANCE = 4.0
FIELD_OF_VIEW = 40.0  # degrees
DIRECTION = (0.6, 0.8, 0.0)  # from the sphere's centre to the camera
FEATURES = 14  # of the full G-buffer; with depth and alpha they are its 16 channels
COLOUR = 3


@dataclass(frozen=True, eq=False)
class Workload:
    """Surfels, their features, and the camera."""

    spread: float
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
        p = self.pinhole
        return Camera.from_pose(p.width, p.height, p.fx, p.fy, p.cx, p.cy, p.to_world, p.near)

    def weights(self, maps: int) -> np.ndarray:
        """Adjoints (maps, H·W) float32 of the maps: what a loss would send back."""
        rng = np.random.default_rng(1)
        return rng.normal(size=(maps, self.pixels)).astype(np.float32)


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
        spread,
        {name: values.astype(np.float32) for name, values in raw.items()},
        rng.uniform(size=(count, FEATURES)).astype(np.float32),
        PinholeCamera(size, size, focal, focal, size / 2, size / 2, to_world),
    )
