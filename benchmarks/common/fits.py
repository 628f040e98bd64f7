"""Trainers of the benchmarks: the full method on a few images of a sphere."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import mitsuba as mi
import numpy as np

from benchmarks.common.report import Row
from benchmarks.common.timing import once, peak_bytes
from mi_refgs import methods
from mi_refgs.data.dataset import Dataset, View
from mi_refgs.data.images import Pixels
from mi_refgs.fitting.train import Trainer
from mi_refgs.reference.camera import look_at

METHOD = "ref_gaussian"
Colour = Callable[[np.ndarray, np.ndarray], np.ndarray]


def ball_data(size: int, focal: float, shots: Iterable[tuple[np.ndarray, Colour]]) -> Dataset:
    """Views of size × size pixels of a unit ball, for each direction towards the camera and its colour.

    `Colour` maps x and y, in pixels from the centre, to the image (H, W, 3) where the ball is seen."""
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    alpha = (np.hypot(x, y) / focal < np.tan(np.arcsin(0.25))).astype(np.float32)
    views = []
    for i, (outward, colour) in enumerate(shots):
        to_world = look_at(4 * outward / np.linalg.norm(outward), np.zeros(3))
        image = np.where(alpha[..., None] > 0, colour(x, y), 1).clip(0, 1).astype(np.float32)
        intrinsics = (size, size, focal, focal, size / 2, size / 2)
        views.append(View(f"{i}", *intrinsics, to_world, Pixels(image, alpha)))
    return Dataset(Path("ball"), "train", tuple(views), np.ones(3, np.float32), False, None)


def sphere_data(size: int, views: int, rng: np.random.Generator) -> Dataset:
    """Views of a unit sphere from random sides, with a smooth random image on it."""

    def waves(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        phases = [x * rng.uniform(0.02, 0.1) + y * rng.uniform(0.02, 0.1) for _ in range(3)]
        return np.stack([0.5 + 0.4 * np.sin(phase) for phase in phases], axis=-1)

    focal = 0.5 * size / np.tan(np.radians(20))
    return ball_data(size, focal, ((rng.normal(size=3), waves) for _ in range(views)))


def make_trainer(surfels: int, data: Dataset) -> Trainer:
    """A trainer at the preset `standard` that keeps its number of surfels."""
    settings = [
        f"surfels.count={surfels}",
        f"surfels.max_count={surfels}",
        "surfels.inside=0",
        "event.densify=false",
        "event.reset_opacity=false",
    ]
    return Trainer(methods.load(METHOD, "standard", settings), data)


def large_step(count: int, size: int, steps: int = 3) -> Row:
    """Return milliseconds per step of the full method's last stage, and this process's largest memory.

    Not in a `__main__`, whose functions a spawned process does not find."""
    mi.set_variant("llvm_ad_rgb")
    trainer = make_trainer(count, sphere_data(size, 2, np.random.default_rng(0)))
    trainer.method.event["mesh"].apply(trainer)
    trainer.fit.iteration = trainer.method.stages()[-1][1].until - steps - 1
    times = [1e3 * once(trainer.step) for _ in range(steps + 1)]
    found = {"surfels": trainer.surfels.count, "size": size, "ms": float(np.median(times[1:]))}
    return found | {"whole_process": peak_bytes()}
