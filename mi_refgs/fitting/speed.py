"""Measures how fast the steps of a method are on this machine.

A step is one of the method's own, on a stand-in for the data set, at two sizes, in each stage and with its
mesh; `cost_model` keeps the times. In between and beyond, they are linear in the number of pixels.

The clock is the CPU time of the main thread. With nothing else on the machine it is the wall time, as this
thread takes part in every kernel of Dr.Jit; beside other processes it stays, while the wall time doubles.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs import __version__
from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import Region
from mi_refgs.data.view import View
from mi_refgs.fitting import cost_model
from mi_refgs.fitting.cost_model import Speed
from mi_refgs.fitting.train import Trainer
from mi_refgs.kernels.device import machine, simd_width
from mi_refgs.methods.build import plain
from mi_refgs.methods.method import Method, Refine
from mi_refgs.synthesis.pathtrace import poses_around

VIEWS = 6
COVERED = 0.35
"""Share of a picture with alpha that the stand-in's object covers; published data sets have 0.1 to 0.5."""
WARM, TIMED, REPEATS = 4, 4, 3
"""Steps before the clock runs, which compile kernels; steps that are timed at once; how often they are, of
which the fastest counts."""


def speed_of(method: Method, has_alpha: bool) -> Speed:
    """How fast steps of a method are here, on pictures with alpha or without: as kept, or measured."""
    subject = machine() | {"simd_width": simd_width(), "mi_refgs": __version__, "cut_out": has_alpha}
    return cost_model.kept(subject | _cost(method), lambda: measured(method, has_alpha))


def _cost(method: Method) -> dict[str, Any]:
    """What the time of a step depends on: two methods that differ in rates or weights alone are one."""
    weights = {name: bool(value) for name, value in asdict(method.loss).items()}
    parts = {name: getattr(method, name) for name in ("surfels", "light", "surroundings", "mesh", "stage")}
    return {
        "method": {name: plain(part) for name, part in parts.items() if part is not None},
        "loss": weights,
    }


def measured(method: Method, has_alpha: bool) -> Speed:
    """Run a few steps of every stage at both sizes."""
    (small, mesh), (large, _) = (_measured(method, has_alpha, size) for size in cost_model.SIZES)
    return Speed({name: [small[name], large[name]] for name in small}, *mesh)


def _measured(method: Method, has_alpha: bool, size: int) -> tuple[dict[str, float], tuple[float, float]]:
    """Seconds of a step by stage, and of a mesh without views and of each of its views."""
    data_options = replace(method.data, coarse=())
    still = replace(method, refine=Refine(), exposure=None, select=None, data=data_options)
    trainer = Trainer(replace(still, mesh=None), stand_in(has_alpha, size))
    every = 1 if method.light is None else method.light.every
    timed = max(TIMED // every, 1) * every
    steps, mesh, begin = {}, (0.0, 0.0), 0
    for name, stage in method.stages():
        if method.mesh is not None and trainer.occluder.empty and trainer.shading(stage.until).traceable:
            trainer.method = still
            mesh = _mesh(trainer)
            trainer.method = replace(still, mesh=None)
        first = min(begin + 1, stage.until - 1)
        _run(trainer, first, max(WARM, every))
        few = partial(_run, trainer, first, timed)
        steps[name] = min(_seconds(few) / timed for _ in range(REPEATS))
        begin = stage.until
    return steps, mesh


def _mesh(trainer: Trainer) -> tuple[float, float]:
    """Seconds of a mesh without views, and of each view: from one of all views, and one of four times all."""
    data = trainer.data
    trainer.extract_mesh()
    few = min(_seconds(trainer.extract_mesh) for _ in range(REPEATS))
    trainer.data = replace(data, views=4 * data.views)
    many = min(_seconds(trainer.extract_mesh) for _ in range(REPEATS))
    trainer.data = data
    each = max(many - few, 0) / (3 * VIEWS)
    return max(few - VIEWS * each, 0), each


def _run(trainer: Trainer, first: int, steps: int) -> None:
    """Steps from iteration `first` on, so that short stages do not end meanwhile."""
    trainer.iteration = first
    for _ in range(steps):
        trainer.step()
    dr.sync_thread()


def _seconds(call: Callable[[], Any]) -> float:
    # The main thread sleeps while another device computes.
    clock = time.thread_time if mi.variant().startswith("llvm") else time.perf_counter
    begin = clock()
    call()
    return clock() - begin


def stand_in(has_alpha: bool, size: int) -> Dataset:
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
        if has_alpha:
            image = alpha[..., None] * image + 1 - alpha[..., None]
        focal, middle = 1.6 * size, size / 2
        place = (size, size, focal, focal, middle, middle, to_world)
        views.append(
            View(f"{i}", *place, image, alpha if has_alpha else None, None, None, is_linear_radiance=False)
        )
    region = None if has_alpha else Region((0.0, 0.0, 0.0), 1.0)
    return Dataset(Path("stand-in"), "train", tuple(views), np.ones(3, np.float32), False, None, None, region)
