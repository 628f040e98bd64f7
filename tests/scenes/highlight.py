"""Images of a ball whose highlight moves with the camera, and a method that fits it in 30 steps."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.data.dataset import Dataset, View
from mi_refgs.data.images import Pixels
from mi_refgs.methods import load_resolved
from mi_refgs.methods.method import Method
from mi_refgs.reference.camera import look_at
from mi_refgs.runs.run import Run

SIZE = 24
METHOD = """
iterations = 30
checkpoint_every = 5
log_every = 3
[surfels]
count = 150
max_count = 220
degree = { radiance_sh = 1 }
sh_raise = { start = 2, until = 4, every = 2 }
initial = { opacity = 0.6, metallic = 0.3, roughness = 0.3 }
[light]
height = 8
every = 3
[stage.initial]
until = 8
at = "surfel"
diffuse = "irradiance"
[stage.deferred]
until = 30
restart = ["albedo", "metallic", "roughness", "light"]
[mesh]
extract = { start = 9, until = 30, every = 10 }
resolution = 24
[refine]
densify = { start = 3, until = 24, every = 6 }
gradient = 1e-6
reset = { start = 0, until = 24, every = 14 }
reset_raise = ["metallic"]
propagate = { when = { start = 0, until = 24, every = 5 }, hold = 4, noise = 0.1 }
relocate = { when = { start = 3, until = 24, every = 7 }, opacity = 0.2, grow = 0.1, noise = 1e5 }
[data]
coarse = [{ until = 6, block = 3 }, { until = 12, block = 2 }]
[loss]
smooth = 0.1
alpha = 0.1
"""


def ball(size: int = SIZE, views: int = 6) -> Dataset:
    """A ball with a sharp highlight that moves with the camera, from a ring of views."""
    focal, images = 1.6 * size, []
    y, x = (np.mgrid[0:size, 0:size] + 0.5 - size / 2) / focal
    for i in range(views):
        angle = 2 * np.pi * i / views
        outward = np.array([np.cos(angle) * 0.9, np.sin(angle) * 0.9, np.sqrt(0.19)])
        to_world = look_at(4 * outward, np.zeros(3))
        radius = np.hypot(x, y)
        alpha = (radius < np.tan(np.arcsin(0.25))).astype(np.float32)
        shine = np.exp(-((x - 0.05) ** 2 + (y + 0.05) ** 2) / 0.002)
        colour = np.stack([0.3 + 0.6 * shine, 0.4 + x, 0.5 + 0.5 * shine + y], axis=-1)
        image = (alpha[..., None] * colour + 1 - alpha[..., None]).clip(0, 1).astype(np.float32)
        intrinsics = size, size, focal, focal, size / 2, size / 2
        images.append(View(f"{i}", *intrinsics, to_world, Pixels(image, alpha)))
    return Dataset(Path("ball"), "train", tuple(images), np.ones(3, np.float32), False, None)


def small_method(folder: Path) -> Method:
    """The method METHOD, by a file in this folder."""
    path = folder / "small.toml"
    path.write_text(METHOD)
    return load_resolved(path)


def run_folder(path: Path, method: Method) -> Run:
    run = Run(path)
    run.create(method, "ball")
    return run
