"""Time and memory of a fit, estimated before its first step, and the image size that fits the time.

The time of a step is measured once per machine (`cost_model` caches it): steps of the method itself on a
synthetic data set, at two sizes, in each stage and with its mesh. It is linear in the number of pixels.

The clock is the CPU time of the main thread. On an idle machine it is the wall time, since this thread takes
part in every kernel of Dr.Jit; beside other processes it stays, while the wall time doubles.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs import __version__
from mi_refgs.data import stereo
from mi_refgs.data.dataset import Dataset, fitting_downscale
from mi_refgs.data.images import Pixels
from mi_refgs.data.poses import poses_around
from mi_refgs.data.region import Region
from mi_refgs.data.view import View
from mi_refgs.fitting import cost_model
from mi_refgs.fitting.cost_model import Speed
from mi_refgs.fitting.targets import bytes_of
from mi_refgs.fitting.train import FUSED_VIEWS, Trainer
from mi_refgs.kernels.device import machine, simd_width
from mi_refgs.methods.build import plain
from mi_refgs.methods.method import Method, Refine
from mi_refgs.methods.read import PRESETS
from mi_refgs.runs.views import read_views

VIEWS = 6
COVERED = 0.35  # fraction of the synthetic images that the object covers; published data sets have 0.1 to 0.5
WARM, TIMED, REPEATS = 4, 4, 3
"""Steps before the timed ones, which compile kernels; steps timed together; repetitions, of which the fastest
counts."""
SMALL_IMAGE = 256 * 256  # pixels of an image up to which it is not downscaled, unless the method says so
LEAST = 96  # pixels of the shorter side below which no image is downscaled: smaller images show no surface
PIXELS_PER_SURFEL = 16
"""Pixels of an image per surfel, at the largest number of surfels, above which images are downscaled: they
show more than the surfels can."""
SAFETY = 0.8  # fraction of the time limit that the estimate may reach: data sets differ by as much
GROWTH, OPEN_GROWTH = 1.0, 0.75
"""Mean time of a step relative to the synthetic data set, with alpha and without: the number of surfels
grows, but opaque ones hide others, and without alpha surfels start far larger than they end."""
CAPACITY_TIME = 1.45
"""Relative time per step with twice the surfels: 1.43 for `base_2dgs` on *chair*, 200², 20,000 to 40,000."""
START, OPEN_START = 10.0, 20.0
"""Seconds for the visual hull, previews, checkpoints and artefacts; besides, without alpha, for the decisions
on gains and camera corrections."""
STEREO = 0.6  # seconds per view that stereo compares
DECODING = 1.5e-8  # seconds per pixel of a file, once per image: JPEG 8e-9, PNG 2e-8
WORTH = 1e7  # iterations × pixels from which a fit takes minutes, and an estimate is worth its time


def speed_of(method: Method, has_alpha: bool, tell: Callable[[str], None] = lambda _: None) -> Speed:
    """Speed of a method on this machine, on images with alpha or without: cached, or measured.

    Methods that differ in learning rates or weights only are equally fast. `tell` is called before it is
    measured.
    """
    parts = {name: getattr(method, name) for name in ("surfels", "light", "surroundings", "mesh", "stage")}
    subject = machine() | {"simd_width": simd_width(), "mi_refgs": __version__, "cut_out": has_alpha}
    subject["method"] = {name: plain(part) for name, part in parts.items() if part is not None}
    subject["loss"] = {name: bool(loss.weight) for name, loss in method.loss.items()}

    def measure() -> Speed:
        tell("measuring the speed of this machine, once per kind of method (about half a minute)")
        return measured(method, has_alpha)

    return cost_model.kept(subject, measure)


def measured(method: Method, has_alpha: bool) -> Speed:
    """Run a few steps of every stage at both sizes."""
    (small, mesh), (large, _) = (_measured(method, has_alpha, size) for size in cost_model.SIZES)
    return Speed({name: [small[name], large[name]] for name in small}, *mesh)


def _measured(method: Method, has_alpha: bool, size: int) -> tuple[dict[str, float], tuple[float, float]]:
    """Seconds per step by stage; per mesh, and per view of a mesh."""
    whole = replace(method.data, coarse=(), crop=None)
    still = replace(method, refine=Refine(), exposure=None, cameras=None, select=None, data=whole)
    trainer = Trainer(still, synthetic_data(has_alpha, size))
    every = 1 if method.light is None else method.light.every
    timed = max(TIMED // every, 1) * every
    steps, mesh, begin = {}, (0.0, 0.0), 0
    for name, stage in method.stages():
        if method.mesh is not None and trainer.fit.occluder.empty and trainer.shading(stage.until).traceable:
            mesh = _mesh(trainer)
        first = min(begin + 1, stage.until - 1)

        def run(count: int, name: str = name, first: int = first) -> None:
            with trainer.held_in_stage(name, first, share_light=True):
                for _ in range(count):
                    trainer.step()
                dr.sync_thread()

        run(max(WARM, every))
        steps[name] = min(_seconds(partial(run, timed)) / timed for _ in range(REPEATS))
        begin = stage.until
    return steps, mesh


def _mesh(trainer: Trainer) -> tuple[float, float]:
    """Seconds per mesh, and per view of a mesh: from a mesh of all views, and one of four times all."""
    cameras = [view.camera() for view in trainer.data.views]
    trainer.extract_mesh(cameras)
    few, many = (
        min(_seconds(partial(trainer.extract_mesh, seen)) for _ in range(REPEATS))
        for seen in (cameras, 4 * cameras)
    )
    each = max(many - few, 0) / (3 * VIEWS)
    return max(few - VIEWS * each, 0), each


def _seconds(call: Callable[[], Any]) -> float:
    # The main thread sleeps while another device computes.
    clock = time.thread_time if mi.variant().startswith("llvm") else time.perf_counter
    begin = clock()
    call()
    return clock() - begin


def synthetic_data(has_alpha: bool, size: int) -> Dataset:
    """Images of noise from a ring of cameras: of a ball with alpha, or of an open scene."""
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
        views.append(View(f"{i}", *place, Pixels(image, alpha if has_alpha else None)))
    region = None if has_alpha else Region((0.0, 0.0, 0.0), 1.0)
    white = np.ones(3, np.float32)
    return Dataset(Path("synthetic"), "train", tuple(views), white, False, None, None, region)


def sized(method: Method, path: Path, tell: Callable[[str], None] = lambda _: None) -> Method:
    """The method with the size of images decided: by default, that of its preset.

    `tell` is called if images are downscaled. Raises InputError as `read_dataset` does.
    """
    if method.data.downscale is not None:
        return method
    budget = PRESETS[method.preset].pixels if method.preset in PRESETS else sys.maxsize
    factor, width, height = fitting_downscale(path, method.data.images, budget)
    if factor > 1:
        tell(
            f"{path}: images of {width} × {height} pixels are read as {width // factor} × "
            f"{height // factor} to fit the time of preset {method.preset}; --set data.downscale=1 avoids it"
        )
    return method.downscaled(factor)


@dataclass(frozen=True)
class Estimate:
    """Time and memory of a fit."""

    seconds: float
    bytes: float
    width: int
    height: int

    def sentence(self, iterations: int) -> str:
        """The estimate as one sentence."""
        return (
            f"estimate: {minutes(self.seconds)} if nothing else runs, and {self.bytes / 1e9:.1f} GB, for "
            f"{iterations} iterations on {self.width} × {self.height} pixels with {dr.thread_count()} threads"
        )


def minutes(seconds: float) -> str:
    """Format a time, not more precisely than it is known."""
    return f"{seconds:.0f} s" if seconds < 90 else f"{seconds / 60:.1f} min"


def planned(
    method: Method, path: Path, limit: float | None = None, tell: Callable[[str], None] = lambda _: None
) -> tuple[Method, Estimate | None]:
    """The method with the size of images decided, and an estimate of its fit, or None if it takes seconds.

    Chooses the largest images whose fit takes at most `limit` seconds, by default the time of the preset.
    Images of at most SMALL_IMAGE pixels are not downscaled, nor is a size changed that the method gives. The
    load of the machine has no influence. `tell` is called with the choice. Raises InputError as
    `read_dataset` does.
    """
    # The time limit, and the images.
    promise = PRESETS[method.preset].minutes if method.preset in PRESETS else None
    limit = 60 * promise if limit is None and promise is not None else limit
    data = read_views(method.downscaled(1), path, "train", truth=False, decode=False)
    width, height = data.views[0].width, data.views[0].height

    # Their size, unless the time limit decides it, and an estimate where the fit takes minutes.
    free = limit is not None and method.data.downscale is None
    method = method.downscaled(1) if free else sized(method, path, tell)
    if method.iterations * width * height < WORTH:
        return method, None
    speed = speed_of(method, data.has_alpha, tell)

    def at(factor: int, capacity: float = 1.0) -> Estimate:
        size = width, height
        return estimate(method, speed, len(data.views), size, factor, data.has_alpha, capacity)

    factor = method.data.downscale or 1
    if limit is None or not free:
        return method, at(factor)

    # The smallest factor whose estimate keeps the limit, and whose pixels the surfels can show.
    most = min(width, height) // LEAST if width * height > SMALL_IMAGE else 1
    surfels = method.surfels.most * max(_capacities(method).values(), default=1.0)
    while factor < most and width * height > PIXELS_PER_SURFEL * surfels * factor**2:
        factor += 1
    shown = factor
    while at(factor).seconds > SAFETY * limit and factor < most:
        factor += 1
    chosen = at(factor)
    if factor > 1:
        reason, remedy = f"the fit takes {minutes(limit)} at most", "--minutes M gives it other time"
        if factor == shown:
            reason = f"{surfels:,.0f} surfels can show them"
            remedy = "surfels.max_count gives it more surfels"
        tell(
            f"{path}: images of {width} × {height} pixels are read as {chosen.width} × {chosen.height}, so "
            f"that {reason}; --set data.downscale=1 reads them whole ({minutes(at(1).seconds)}), {remedy}"
        )
    if chosen.seconds > limit:
        tell(
            f"{path}: the fit takes {minutes(chosen.seconds)}, more than {minutes(limit)}; "
            f"--set data.downscale={factor + 1} reads smaller images"
        )
    affordable = _with_affordable_capacity(
        method, lambda capacity: at(factor, capacity).seconds <= SAFETY * limit
    )
    if affordable != method:
        tell(
            f"{path}: fits with more surfels would take more than {minutes(limit)}, and are not tried; "
            "--minutes M gives them other time"
        )
    return affordable.downscaled(factor), chosen


def _capacities(method: Method) -> dict[str, float]:
    """The factor of the number of surfels that each optional component of a method sets."""
    components = {} if method.select is None else method.select.component
    return {name: one.change.get("surfels", {}).get("capacity", 1.0) for name, one in components.items()}


def _with_affordable_capacity(method: Method, fits: Callable[[float], bool]) -> Method:
    """The method without the components whose number of surfels does not fit into the time."""
    if method.select is None:
        return method
    slow = {name for name, factor in _capacities(method).items() if factor > 1 and not fits(factor)}
    kept = {name: one for name, one in method.select.component.items() if name not in slow}
    return replace(method, select=replace(method.select, component=kept))


def estimate(
    method: Method,
    speed: Speed,
    views: int,
    size: tuple[int, int],  # width, height
    factor: int,
    has_alpha: bool = True,
    capacity: float = 1.0,
) -> Estimate:
    """Estimate a fit to so many images of `size`, with or without alpha, downscaled by `factor`, with
    `capacity` times the surfels."""
    width, height = size[0] // factor, size[1] // factor
    steps = _steps(method, speed, (width, height), method.iterations)
    if method.metal_trial is not None:  # the start that is not continued
        steps += _steps(method, speed, (width, height), min(method.metal_trial.until, method.iterations))
    meshes = 0 if method.mesh is None else method.mesh.extract.count(method.iterations)
    files = views * size[0] * size[1] * DECODING
    steps *= (GROWTH if has_alpha else OPEN_GROWTH) * CAPACITY_TIME ** math.log2(capacity)
    fused = views + (meshes - 1) * min(views, FUSED_VIEWS) if meshes else 0
    seconds = START + files + steps + meshes * speed.mesh + fused * speed.mesh_view
    if not has_alpha:
        seconds += OPEN_START + STEREO * min(views, stereo.VIEWS)
    return Estimate(seconds, bytes_of(method, views, (width, height)), width, height)


def _steps(method: Method, speed: Speed, size: tuple[int, int], last: int) -> float:
    """Seconds of the iterations up to `last`, on images of a width and height."""
    begin, seconds = 0, 0.0
    for name, stage in method.stages():
        for pixels, count in _resolutions(method, size, begin, min(stage.until, last)):
            seconds += count * speed.step(name, pixels)
        begin = stage.until
    return seconds


def _resolutions(method: Method, size: tuple[int, int], begin: int, end: int) -> list[tuple[int, int]]:
    """Pixels that the iterations after `begin` to `end` render of images of a width and height, and how many
    iterations render so many."""
    ends = sorted({end, *(coarse.until for coarse in method.data.coarse if begin < coarse.until < end)})
    return [
        (method.data.pixels_at(last, *size), last - first)
        for first, last in pairwise([begin, *ends])
        if last > first
    ]
