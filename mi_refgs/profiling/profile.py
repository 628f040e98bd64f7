"""Cost of training steps and images on a scene: times, kernel launches, and the work of splatting."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from itertools import cycle
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.train import Trainer
from mi_refgs.profiling.phases import phase_times
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera, Footprints, TileLists, list_by_tile, project, surfel_count
from mi_refgs.splat.lanes import advance
from mi_refgs.surfels.attributes import sigmoid
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import UInt32


@dataclass(frozen=True)
class Counts:
    """Splatting work of one view."""

    surfels: int
    pixels: int
    tile_pixels: int  # per tile
    pairs: int  # surfel-tile pairs listed
    visited: int  # pairs that a tile reached before all of its pixels had ended
    contributing: int  # surfel-pixel pairs with α ≥ ALPHA_MIN, before the pixel's end
    covered: int  # pixels with a contribution
    pixels_of_surfel: UInt32  # (N,) pixels to which a surfel contributes

    @property
    def evaluated(self) -> int:
        """Surfel-pixel evaluations: a visited pair is evaluated at every pixel of its tile at once."""
        return self.visited * self.tile_pixels


def count(footprints: Footprints, lists: TileLists, camera: Camera) -> Counts:
    """Walk the lists as `splat.composite` does, and count; waits for the device."""
    columns = [dr.detach(column) for column in footprints.columns]
    surfels, pixels = dr.width(columns[0]), camera.width * camera.height
    pixels_of_surfel = dr.zeros(mi.UInt32, surfels)
    width, height = camera.tile
    if not lists.pairs:
        return Counts(surfels, pixels, width * height, 0, 0, 0, 0, pixels_of_surfel)
    lane = dr.arange(mi.UInt32, camera.tiles[0] * camera.tiles[1] * width * height)
    tile, local = lane // (width * height), lane % (width * height)
    x = (tile % camera.tiles[0]) * width + local % width - camera.tile_offset[0]
    y = (tile // camera.tiles[0]) * height + local // width - camera.tile_offset[1]
    pixel = mi.Point2f(mi.Float(x) + 0.5, mi.Float(y) + 0.5)
    begin = dr.gather(mi.UInt32, lists.pair_begin, tile)
    end = dr.gather(mi.UInt32, lists.pair_end, tile)

    def condition(pair: Any, active: Any, transmittance: Any, steps: Any, hits: Any) -> Any:
        return active & (pair < end)

    def body(pair: Any, active: Any, transmittance: Any, steps: Any, hits: Any) -> Any:
        surfel = dr.gather(mi.UInt32, lists.surfel_from_pair, pair, active)
        row = [dr.gather(mi.Float, column, surfel, active) for column in columns]
        sample = footprints.primitive.evaluate(row, pixel, camera.near)
        weight, after, goes_on = advance(sample, active, transmittance)
        hit = weight > 0
        dr.scatter_add(pixels_of_surfel, mi.UInt32(1), surfel, hit)
        return pair + 1, goes_on, after, steps + 1, hits + dr.select(hit, mi.UInt32(1), mi.UInt32(0))

    inside = (x < camera.width) & (y < camera.height)
    state = (begin, inside, mi.Float(1), mi.UInt32(0), mi.UInt32(0))
    _, _, _, steps, hits = dr.while_loop(state, condition, body, label="count")
    dr.eval(steps, hits, pixels_of_surfel)
    # A tile continues until the last of its pixels has ended.
    visited = int(dr.sum(dr.block_reduce(dr.ReduceOp.Max, steps, width * height))[0])
    contributing, covered = int(dr.sum(hits)[0]), int(dr.count(hits > 0)[0])
    counts = surfels, pixels, width * height, lists.pairs, visited, contributing, covered
    return Counts(*counts, pixels_of_surfel)


SIZES = (200, 400, 800)  # pixels along the longer side of an image
ROUNDS = 9  # timed images of each kind, in turns, so that other load of the machine slows all kinds equally
FRAME_WARM_UP = 2  # rounds before the first measured one: they compile kernels

Draw = Callable[[Camera, Collection[str]], Frame]  # renders a view with the AOVs of these names


@dataclass(frozen=True)
class FrameProfile:
    """Time of images of one size."""

    width: int
    height: int
    frame_ms: float  # radiance and alpha only, median
    aovs_ms: dict[str, float]  # added by each AOV, median of the differences in a round


def aovs_of(frame: Frame) -> list[str]:
    """The AOVs of a frame that has all, without alpha, which every frame has."""
    # Terms that the model lacks are a single zero.
    terms = {} if frame.terms is None else frame.terms.known()
    return [*frame.maps, "normal", "depth", *(name for name, term in terms.items() if dr.width(term) > 1)]


def profile_frame(draw: Draw, names: Collection[str], camera: Camera, rounds: int = ROUNDS) -> FrameProfile:
    """Time the image of a camera without AOVs and with each of the named ones, in turns."""
    plain: list[float] = []
    more: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(FRAME_WARM_UP + rounds):
        plain.append(_seconds(draw, camera, ()))
        for name, found in more.items():
            found.append(_seconds(draw, camera, (name,)) - plain[-1])
    plain_ms, *more_ms = (1e3 * float(np.median(x[FRAME_WARM_UP:])) for x in (plain, *more.values()))
    return FrameProfile(camera.width, camera.height, plain_ms, dict(zip(more, more_ms, strict=True)))


def _seconds(draw: Draw, camera: Camera, names: Collection[str]) -> float:
    begin = time.perf_counter()
    frame = draw(camera, names)
    dr.eval(frame.radiance, frame.alpha, frame.depth, frame.normal, frame.terms, frame.maps, frame.background)
    dr.sync_thread()
    return time.perf_counter() - begin


WARM_UP = 4  # steps before the first measured one: they compile kernels
VIEWS = 8  # most training views whose work is counted
NEAR_END = 100  # steps before the end of a stage, where every SH degree is in use
FAINT = 0.1
"""Opacity below which a surfel counts as faint: more than twenty such are required for an opaque pixel."""


@dataclass(frozen=True)
class StageProfile:
    """Cost of a step in one stage of the schedule."""

    name: str
    step_ms: float  # median of undisturbed steps
    launches: int  # kernels per step
    misses: int  # kernels compiled in all warm steps together
    phases_ms: dict[str, float]  # by `profiling.phases`, between barriers


@dataclass(frozen=True)
class Work:
    """Splatting work per view, mean over training views; shares are between 0 and 1."""

    views: int
    surfels: int
    pixels: float
    tile_pixels: float  # per tile
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
    """Result of `profile`."""

    stages: tuple[StageProfile, ...]
    work: Work
    allocated: int  # bytes, peak of Dr.Jit
    physical: int  # bytes of the machine


def profile(trainer: Trainer, names: list[str], steps: int) -> Profile:
    """Measure `steps` steps of each named stage of the schedule, twice, and count the work of some views.

    The steps change the trainer's state; nothing is refined, extracted or saved. Raises InputError without
    surfels.
    """
    if trainer.surfels.count == 0:
        raise InputError(
            "none are left", trainer.data.path, "surfels", "profile an earlier run or a data set"
        )
    dr.sync_thread()
    dr.detail.malloc_clear_statistics()
    found = []
    for name in names:
        traced = Shading.resolve(trainer.method.stage[name].shading, mesh=True).occlusion
        if traced and (mesh := trainer.method.event.get("mesh")) is not None and trainer.fit.occluder.empty:
            mesh.apply(trainer)
        found.append(profile_stage(trainer, name, steps))
    allocated = int(dr.detail.malloc_watermark(dr.backend_v(mi.Float)))
    physical = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    return Profile(tuple(found), count_work(trainer), allocated, physical)


def profile_stage(trainer: Trainer, name: str, steps: int) -> StageProfile:
    """Measure times, launches and cache misses of steps in one stage of the schedule."""
    setup, step = trainer.setup, stepper(trainer, name)
    for _ in range(WARM_UP):
        step()
    dr.sync_thread()
    misses, times = dr.detail.launch_stats()[2], []
    for _ in range(steps):
        begin = time.perf_counter()
        step()
        dr.sync_thread()
        times.append(time.perf_counter() - begin)
    misses = dr.detail.launch_stats()[2] - misses
    # The history has replayed kernels as well, which Dr.Jit's own count leaves out.
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        step()
        dr.sync_thread()
    launches = len(dr.kernel_history([dr.KernelType.JIT]))
    stages = phase_times(step, max(steps // 3, 5))
    trainer.setup = setup
    return StageProfile(name, 1e3 * float(np.median(times)), launches, misses, stages)


def stepper(trainer: Trainer, name: str) -> Callable[[], None]:
    """A function that takes a step near the end of a stage, as often as it is called; no event happens.

    Each step filters its light, so that all are alike.
    """
    method, end = trainer.method, trainer.method.stage[name].until
    begin = max((stage.until for _, stage in method.stages() if stage.until < end), default=0)
    if method.light is not None:
        method = replace(method, light=replace(method.light, every=1))
    trainer.fit.prefilter.close()
    trainer.setup = FitSetup(method, trainer.data)
    iterations = cycle(range(max(begin + 1, end - NEAR_END), end + 1))
    return lambda: trainer.gradient_step(next(iterations))


def count_work(trainer: Trainer) -> Work:
    """Count the mean work of up to VIEWS training views, the background's included."""
    tables = trainer.fit.detached()
    chosen = evenly_spread(len(trainer.targets), VIEWS)
    counts: list[Counts] = []
    pixels = []
    for index in chosen:
        camera = trainer.targets[index].camera
        with dr.suspend_grad():
            footprints = project(tables, camera)
            counts.append(count(footprints, list_by_tile(footprints, camera), camera))
        pixels.append(counts[-1].pixels_of_surfel.numpy())
    largest = np.max(pixels, axis=0)
    seen = largest > 0
    opacity, aspect = (np.concatenate(found) for found in zip(*map(_opacity_and_aspect, tables), strict=True))

    def of_seen(values: np.ndarray, summary: Callable[[np.ndarray], Any] = np.mean) -> float:
        return float(summary(values[seen])) if seen.any() else 0.0

    means = ("pixels", "tile_pixels", "covered", "pairs", "evaluated", "contributing")
    return Work(
        views=len(chosen),
        surfels=surfel_count(tables),
        **{name: float(np.mean([getattr(found, name) for found in counts])) for name in means},
        unseen_share=float(1 - seen.mean()),
        single_share=of_seen(largest == 1),
        faint_share=of_seen(opacity < FAINT),
        aspect=of_seen(aspect, np.median),
        footprint=float(np.sum(pixels) / max(np.count_nonzero(pixels), 1)),
    )


def _opacity_and_aspect(surfels: Surfels) -> tuple[np.ndarray, np.ndarray]:
    """Opacity (N,), and the longest deviation over the second."""
    raw = {name: values.astype(np.float64) for name, values in surfels.to_numpy().items()}
    sizes = np.sort(np.maximum(surfels.primitive.extent(raw)[1], np.finfo(np.float32).tiny), axis=1)
    return sigmoid(raw["opacity"][:, 0]), sizes[:, -1] / sizes[:, -2]
