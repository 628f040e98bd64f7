"""How fast the steps of a method are on this machine.

The time of a step is measured: the method's own steps on a stand-in for the data set, at two sizes, in each
stage and with its mesh, for a few seconds. It is kept beside Dr.Jit's kernels, so it is measured once for a
method, a machine and a number of threads. In between and beyond, it is linear in the number of pixels.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.contraction import Region
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.pathtrace import poses_around
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.files import read_json, write_json
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import Method, Refine
from mi_refgs.methods.read import dump

SIZES = 96, 224
"""Pixels along a side of the stand-in's pictures: a step at the second takes about 1.5 times as long."""
VIEWS = 6
COVERED = 0.35
"""Share of a picture with alpha that the stand-in's object covers; published data sets have 0.1 to 0.5."""
WARM, TIMED = 4, 8
"""Steps before the clock runs, which compile kernels, and steps of which the faster half counts."""
BUSY = 1.5
"""Processes waiting for each processor from which on a speed is not kept: it is not that of the machine."""
SPEED_FILE = "mi_refgs_speed.json"
KEPT = 64
"""Methods whose speed is kept."""


@dataclass(frozen=True)
class Speed:
    """Seconds of a step of each stage at each of SIZES, and of the extraction of a mesh at the first."""

    stages: dict[str, list[float]]
    mesh: float  # of its volume
    mesh_view: float  # of each view

    def step(self, stage: str, pixels: int) -> float:
        """Seconds of a step with a picture of so many pixels."""
        small, large = self.stages[stage]
        low, high = (side * side for side in SIZES)
        slope = max(large - small, 0) / (high - low)
        return float(max(small + slope * (pixels - low), 0.5 * small))


def speed_of(method: Method, cut_out: bool) -> Speed:
    """How fast steps of a method are here, on pictures with alpha or without: from the file, or measured."""
    path = Path(os.environ.get("DRJIT_CACHE_DIR", str(Path.home() / ".drjit"))) / SPEED_FILE
    key = _key(method, cut_out)
    known: dict[str, Any] = {}
    with contextlib.suppress(InputError):
        known = read_json(path)
    with contextlib.suppress(KeyError, TypeError):
        return Speed(**known[key])
    busy = _busy()
    speed = measured(method, cut_out)
    if busy:
        return speed
    known = dict(list(known.items())[-KEPT:]) | {key: asdict(speed)}
    with contextlib.suppress(InputError):  # what cannot be kept is measured again
        path.parent.mkdir(parents=True, exist_ok=True)
        write_json(path, known)
    return speed


def _busy() -> bool:
    """Whether others keep the machine busy, as far as the system tells."""
    try:
        return os.getloadavg()[0] > BUSY * (os.cpu_count() or 1)
    except (AttributeError, OSError):
        return False


def _key(method: Method, cut_out: bool) -> str:
    """What the time of a step depends on, as a short name."""
    plain = replace(method, data=type(method.data)(), file="", assignments=(), preset="", seed=0)
    machine = [dr.__version__, dr.thread_count(), os.cpu_count(), cut_out, dump(plain)]
    return hashlib.sha256(json.dumps(machine).encode()).hexdigest()[:24]


def measured(method: Method, cut_out: bool) -> Speed:
    """Run a few steps of every stage at both sizes."""
    (small, mesh), (large, _) = (_measured(method, cut_out, size) for size in SIZES)
    return Speed({name: [small[name], large[name]] for name in small}, *mesh)


def _measured(method: Method, cut_out: bool, size: int) -> tuple[dict[str, float], tuple[float, float]]:
    """Seconds of a step by stage, and of a mesh without views and of each of its views."""
    data_options = replace(method.data, coarse=())
    still = replace(method, refine=Refine(), exposure=None, select=None, data=data_options)
    trainer = Trainer(replace(still, mesh=None), stand_in(cut_out, size))
    every = 1 if method.light is None else method.light.every
    half = max(TIMED // 2 // every, 1) * every
    steps, mesh, begin = {}, (0.0, 0.0), 0
    for name, stage in method.stages():
        if method.mesh is not None and trainer.occluder.empty and trainer.shading(stage.until).traceable:
            trainer.method = still
            mesh = _mesh(trainer)
            trainer.method = replace(still, mesh=None)
        trainer.iteration = min(begin + 1, stage.until - 1)
        _run(trainer, max(WARM, every))
        steps[name] = min(_seconds(lambda: _run(trainer, half)) / half for _ in range(2))
        begin = stage.until
    return steps, mesh


def _mesh(trainer: Trainer) -> tuple[float, float]:
    """Seconds of a mesh without views, and of each view: from one of all views, and one of four times all."""
    data = trainer.data
    trainer.extract_mesh()
    few = _seconds(trainer.extract_mesh)
    trainer.data = replace(data, views=4 * data.views)
    many = _seconds(trainer.extract_mesh)
    trainer.data = data
    each = max(many - few, 0) / (3 * VIEWS)
    return max(few - VIEWS * each, 0), each


def _run(trainer: Trainer, steps: int) -> None:
    for _ in range(steps):
        trainer.step()
    dr.sync_thread()


def _seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def stand_in(cut_out: bool, size: int) -> Dataset:
    """Pictures of noise, of a ball that is cut out or of what is all around, from a ring of cameras."""
    rng = np.random.default_rng(0)
    y, x = (np.mgrid[0:size, 0:size] + 0.5) / size - 0.5
    alpha = (np.hypot(x, y) < np.sqrt(COVERED / np.pi)).astype(np.float32)
    views = []
    angle = 2 * np.pi * np.arange(VIEWS) / VIEWS
    outward = np.stack([0.9 * np.cos(angle), 0.9 * np.sin(angle), np.full(VIEWS, np.sqrt(0.19))], axis=1)
    for i, to_world in enumerate(poses_around(outward, np.zeros(3), 4.0)):
        noise = np.repeat(np.repeat(rng.random((8, 8, 3)), -(-size // 8), axis=0), -(-size // 8), axis=1)
        image = noise[:size, :size].astype(np.float32)
        if cut_out:
            image = alpha[..., None] * image + 1 - alpha[..., None]
        focal, middle = 1.6 * size, size / 2
        place = (size, size, focal, focal, middle, middle, to_world)
        views.append(View(f"{i}", *place, image, alpha if cut_out else None, None, None, linear=False))
    region = None if cut_out else Region((0.0, 0.0, 0.0), 1.0)
    return Dataset(Path("stand-in"), "train", tuple(views), np.ones(3, np.float32), False, None, None, region)
