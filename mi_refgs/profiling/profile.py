"""What a training step costs on a scene of the user's, and what would make it cheaper."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.method import Refine
from mi_refgs.profiling.counts import Counts, count
from mi_refgs.profiling.phases import phase_times
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import list_by_tile, project
from mi_refgs.surfels.attributes import sigmoid

WARM_UP = 4
"""Steps before the first that counts: they compile kernels."""
VIEWS = 8
"""Training views whose work is counted, at most."""
FAINT = 0.1
"""Opacity below which a surfel counts as faint: more than twenty such are needed to hide what is behind."""


@dataclass(frozen=True)
class StageProfile:
    """A step of one stage of the schedule."""

    name: str
    step_ms: float  # median of undisturbed steps
    launches: int  # kernels a step
    misses: int  # kernels compiled in all warm steps together
    phases_ms: dict[str, float]  # by `profiling.phases`, between barriers


@dataclass(frozen=True)
class Work:
    """What a view costs, as the mean over training views; shares are between 0 and 1."""

    views: int
    surfels: int
    pixels: float
    tile_pixels: float  # of a tile
    covered: float  # pixels with a contribution
    pairs: float  # surfel-tile pairs listed
    evaluated: float  # surfel-pixel evaluations
    contributing: float  # evaluations that contribute
    unseen_share: float  # surfels that contribute in none of the views
    single_share: float  # of the seen, those that never contribute to more than one pixel
    faint_share: float  # of the seen, those of an opacity below FAINT
    aspect: float  # length over width of the seen, median
    footprint: float  # pixels of a seen surfel in a view in which it is seen, mean

    @property
    def share(self) -> float:
        """Share of the evaluated pairs that contribute."""
        return self.contributing / max(self.evaluated, 1)


@dataclass(frozen=True)
class Profile:
    """All that was measured."""

    stages: tuple[StageProfile, ...]
    work: Work
    allocated: int  # bytes: the most that Dr.Jit held
    physical: int  # bytes: what the machine has


def profile(trainer: Trainer, names: list[str], steps: int) -> Profile:
    """Measure `steps` steps of each named stage of the schedule, twice, and count the work of some views.

    The steps are real and change the trainer's state; nothing is refined, extracted or saved meanwhile.
    Raises InputError if there is no surfel to draw.
    """
    if trainer.surfels.count == 0:
        raise InputError(f"{trainer.data.path}: surfels: none are left; profile an earlier run or a data set")
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    found = []
    for name in names:
        mesh = trainer.method.mesh
        traced = Shading.of(trainer.method.stage[name], mesh=True).occlusion
        if traced and mesh is not None and trainer.occluder.mesh() is None:
            trainer.extract_mesh()
        found.append(profile_stage(trainer, name, steps))
    allocated = int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return Profile(tuple(found), count_work(trainer), allocated, physical)


def profile_stage(trainer: Trainer, name: str, steps: int) -> StageProfile:
    """Times, launches and cache misses of steps in one stage of the schedule."""
    with held_in_stage(trainer, name) as prepare:
        for _ in range(WARM_UP):
            prepare()
            trainer.step()
        dr.sync_thread()
        misses = dr.detail.launch_stats()[2]
        times = []
        for _ in range(steps):
            prepare()
            begin = time.perf_counter()
            trainer.step()
            dr.sync_thread()
            times.append(time.perf_counter() - begin)
        misses = dr.detail.launch_stats()[2] - misses
        prepare()
        launches = _launches(trainer.step)
        stages = phase_times(trainer.step, max(steps // 3, 5), prepare)
    return StageProfile(
        name=name,
        step_ms=1e3 * float(np.median(times)),
        launches=launches,
        misses=misses,
        phases_ms=stages,
    )


def _launches(call: Callable[[], None]) -> int:
    """Kernels that a call launches, replayed ones too (Dr.Jit's own count leaves those out)."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        call()
        dr.sync_thread()
    return len(dr.kernel_history([dr.KernelType.JIT]))


@contextmanager
def held_in_stage(trainer: Trainer, name: str) -> Iterator[Callable[[], None]]:
    """Keep the iteration in a stage (by what is to be called before each step), and let nothing fall due.

    Every step filters its light, which those of a fit may share (`light.every`), so that all steps are alike.
    """
    method, schedule, before = trainer.method, trainer.schedule, trainer.iteration
    stages = method.stages()
    place = [found for found, _ in stages].index(name)
    first, last = stages[place - 1][1].until if place else 0, stages[place][1].until
    # The first iteration of a stage may reset materials.
    first = min(first + 1, last - 1)
    if not first <= before < last:
        trainer.iteration = max(first, last - 100)
    light = None if method.light is None else replace(method.light, every=1)
    trainer.method = replace(method, refine=Refine(), mesh=None, light=light, exposure=None)
    trainer.schedule = replace(schedule, method=trainer.method)
    trainer.window.close()

    def prepare() -> None:
        if trainer.iteration >= last:
            trainer.iteration = first

    try:
        yield prepare
    finally:
        trainer.method, trainer.schedule, trainer.iteration = method, schedule, before


def count_work(trainer: Trainer) -> Work:
    """Mean work of up to VIEWS training views."""
    surfels = trainer.surfels.detach()
    chosen = np.linspace(0, len(trainer.targets) - 1, min(VIEWS, len(trainer.targets))).astype(int)
    counts: list[Counts] = []
    pixels = []
    for index in chosen:
        camera = trainer.targets[index].camera
        with dr.suspend_grad():
            footprints = project(surfels, camera)
            counts.append(count(footprints, list_by_tile(footprints, camera), camera))
        pixels.append(counts[-1].pixels_of_surfel.numpy())
    largest = np.max(pixels, axis=0)
    seen = largest > 0
    raw = {name: values.astype(np.float64) for name, values in surfels.to_numpy().items()}
    sizes = np.sort(np.maximum(surfels.primitive.extent(raw)[1], np.finfo(np.float32).tiny), axis=1)
    opacity = raw["opacity"]

    def mean(name: str) -> float:
        return float(np.mean([getattr(found, name) for found in counts]))

    def of_seen(values: np.ndarray, summary: Callable[[np.ndarray], Any] = np.mean) -> float:
        return float(summary(values[seen])) if seen.any() else 0.0

    return Work(
        views=len(chosen),
        surfels=surfels.count,
        pixels=mean("pixels"),
        tile_pixels=mean("tile_pixels"),
        covered=mean("covered"),
        pairs=mean("pairs"),
        evaluated=mean("evaluated"),
        contributing=mean("contributing"),
        unseen_share=float(1 - seen.mean()),
        single_share=of_seen(largest == 1),
        faint_share=of_seen(sigmoid(opacity[:, 0]) < FAINT),
        aspect=of_seen(sizes[:, -1] / sizes[:, -2], np.median),
        footprint=float(np.sum(pixels) / max(np.count_nonzero(pixels), 1)),
    )
