"""Trainers of the benchmarks: the full method on a few images of a sphere."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs import methods
from mi_refgs.data.dataset import Dataset, View
from mi_refgs.data.images import Pixels
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import Method
from mi_refgs.reference.camera import look_at

METHOD = "ref_gaussian"


def sphere_data(size: int, views: int, rng: np.random.Generator) -> Dataset:
    """Views of a unit sphere with a smooth random image on it."""
    focal = 0.5 * size / np.tan(np.radians(20))
    y, x = np.mgrid[0:size, 0:size] + 0.5 - size / 2
    inside = (np.hypot(x, y) / focal < np.tan(np.arcsin(0.25))).astype(np.float32)
    found = []
    for i in range(views):
        outward = rng.normal(size=3)
        to_world = look_at(4 * outward / np.linalg.norm(outward), np.zeros(3))
        waves = [np.sin(x * rng.uniform(0.02, 0.1) + y * rng.uniform(0.02, 0.1)) for _ in range(3)]
        colour = 0.5 + 0.4 * np.stack(waves, axis=-1)
        image = (inside[..., None] * colour + 1 - inside[..., None]).astype(np.float32)
        camera = (size, size, focal, focal, size / 2, size / 2, to_world)
        found.append(View(f"{i}", *camera, Pixels(image, inside)))
    return Dataset(Path("sphere"), "train", tuple(found), np.ones(3, np.float32), False, None)


def make_trainer(surfels: int, data: Dataset) -> tuple[Trainer, Method]:
    """A trainer at the preset `standard` that keeps its number of surfels, and its method."""
    settings = [f"surfels.count={surfels}", f"surfels.max_count={surfels}", "surfels.inside=0", "refine={}"]
    method = methods.load(METHOD, "standard", settings)
    return Trainer(method, data), method
