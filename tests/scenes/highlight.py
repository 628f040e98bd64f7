"""Images of a ball whose highlight moves with the camera, and a method that fits it in 30 steps."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from benchmarks.common.fits import ball_data
from mi_refgs.data.dataset import Dataset
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods import load_resolved
from mi_refgs.methods.method import Method
from mi_refgs.runs.run import Run
from mi_refgs.surfels.table import Surfels
from tests.scenes.tiny import write_method

SIZE = 24
METHOD = """
iterations = 30
checkpoint_every = 5
log_every = 3
light = { height = 8, every = 3 }
[surfels]
count = 150
max_count = 220
degree = { radiance_sh = 1 }
sh_raise = { start = 2, until = 4, every = 2 }
initial = { opacity = 0.6, metallic = 0.3, roughness = 0.3 }
[stage]
initial = { until = 8, at = "surfel", diffuse = "irradiance" }
deferred = { until = 30, restart = ["albedo", "metallic", "roughness", "light"] }
[event]
mesh = { when = { start = 9, until = 30, every = 10 }, resolution = 24 }
densify = { when = { start = 3, until = 24, every = 6 }, prune_extent = 1.0 }
reset_opacity = { when = { start = 0, until = 24, every = 14 }, raise_to_start = ["metallic"] }
[event.propagate]
when = { start = 0, until = 24, every = 5 }
hold = 4
noise = 0.1
[data]
coarse = [{ until = 6, block = 3 }, { until = 12, block = 2 }]
[loss]
l1 = 1.0
gain = 1e-3
smooth = 0.1
alpha = 0.1
"""


def ball(size: int = SIZE, views: int = 6) -> Dataset:
    """A ball with a sharp highlight that moves with the camera, from a ring of views."""
    focal, angle = 1.6 * size, 2 * np.pi * np.arange(views) / views

    def colour(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        x, y = x / focal, y / focal
        shine = np.exp(-((x - 0.05) ** 2 + (y + 0.05) ** 2) / 0.002)
        return np.stack([0.3 + 0.6 * shine, 0.4 + x, 0.5 + 0.5 * shine + y], axis=-1)

    outward = np.stack([0.9 * np.cos(angle), 0.9 * np.sin(angle), np.sqrt(0.19) + 0 * angle], axis=-1)
    return ball_data(size, focal, ((direction, colour) for direction in outward))


def small_method(folder: Path, text: str = METHOD) -> Method:
    return load_resolved(write_method(folder, text))


def without(method: Method, *names: str) -> Method:
    """The method without these events, by default those that edit surfels."""
    gone = names or ("densify", "reset_opacity", "propagate")
    return replace(method, event={name: x for name, x in method.event.items() if name not in gone})


def run_folder(path: Path, method: Method) -> Run:
    run = Run(path)
    run.create(method, "ball")
    return run


def step_to(trainer: Trainer, iteration: int) -> Trainer:
    """Take steps up to an iteration, and wait for the device."""
    while trainer.iteration < iteration:
        trainer.step()
    dr.sync_thread()
    return trainer


def set_rows(table: Any, name: str, rows: Any, value: float) -> None:
    """Give rows of a table of a fit another raw value."""
    raw = table.surfels.to_numpy()
    raw[name][rows] = value
    table.replace(Surfels.from_numpy(raw))


def require_same_state(expected: Trainer, found: Trainer) -> dict[str, np.ndarray]:
    """Require that two fits have checkpoints of equal bits, but for the seconds; return the second one's."""
    one, other = expected.fit.arrays(), found.fit.arrays()
    assert one.keys() == other.keys()
    for name in one.keys() - {"seconds"}:
        np.testing.assert_array_equal(other[name], one[name], err_msg=name)
    return other
