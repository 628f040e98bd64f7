"""Times, work and errors of the splatter, against other renderers and the machine's limits.

    python -m benchmarks.splatting                     every case, in five minutes on 2 cores
    python -m benchmarks.splatting --small -o out      a small instance, below a minute

Writes splatting.json; `python -m benchmarks.pages` makes the tables and the plot of docs/splatting.md. FLOPs
of a contributing pair are counted by hand from the formulas, an exponential as 12: forward about 36 for the
footprint and 24 for compositing; forward and backward 260, where the footprint is evaluated twice.
Evaluations that do not contribute, sorting and memory are not included, so `contributing · flops / peak` is a
lower bound of the time of any renderer of these surfels."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from multiprocessing import get_context
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.optimize import nnls
from tqdm import tqdm

from benchmarks.common import timing
from benchmarks.common.fits import large_step, make_trainer, sphere_data
from benchmarks.common.report import Row, benchmark
from benchmarks.common.timing import once
from benchmarks.profile import phases_of, stepper
from benchmarks.splatting.cases import COLOUR, FEATURES, PAGE, SMALL, Settings, Workload, sphere
from benchmarks.splatting.renderers import Ours, Volprim
from benchmarks.stability.cases import Case, sky
from benchmarks.stability.measure import measure as measure_case
from mi_refgs.constants import tile_size
from mi_refgs.splat import list_by_tile, project

FLOPS = {"forward": 60, "both": 260}
CHAINS = 16  # independent sums per lane: more than latency times ports of any CPU's multiply-add unit
STEPS = 4096
VECTORS = 256  # SIMD vectors of 16 lanes: enough blocks for every thread
TRIES = 12


def measure_peak() -> float:
    """Return the multiply-add rate of all threads in GFLOP/s: the best of some tries."""
    factors = [dr.opaque(mi.Float, 0.5 + 0.01 * i) for i in range(CHAINS)]
    steps = dr.opaque(mi.UInt32, STEPS)
    lanes = VECTORS * 16 * dr.thread_count()

    def multiply_add() -> Any:
        def body(i: Any, sums: list[Any]) -> Any:
            return i + 1, [dr.fma(s, factor, factor) for s, factor in zip(sums, factors, strict=True)]

        lane = dr.arange(mi.Float, lanes)
        state = (dr.zeros(mi.UInt32, lanes), [lane + k for k in range(CHAINS)])
        _, sums = dr.while_loop(state, lambda i, sums: i < steps, body, label="peak")
        return sum(sums, mi.Float(0))

    return 2e-9 * lanes * STEPS * CHAINS / min(once(multiply_add) for _ in range(TRIES))


MARGIN = 16
"""Pixels around the part whose surfels the reference considers too: those that miss a tile are seen."""
CLASSES = ("position", "rotation", "scale", "opacity", "radiance_sh")


def crop(workload: Workload, size: int, margin: int = 0) -> Workload:
    """The same surfels in a part of the view, a third from its left and upper edge; tiles stay in place."""
    p = workload.pinhole
    size = min(size, p.width, p.height)
    tile = tile_size(abs(p.fx))
    left, top = (
        step * (edge // 3 // step) - margin for step, edge in zip(tile, (p.width, p.height), strict=True)
    )
    size += 2 * margin
    return replace(workload, pinhole=replace(p, width=size, height=size, cx=p.cx - left, cy=p.cy - top))


def compare(workload: Workload, size: int) -> dict[str, float]:
    """Errors of the part, as `stability.measure` defines them; the reference blends in the product's order.

    order: largest relative depth difference of two surfels in the wrong order where they show; left_out:
    share of the pixels in the float64 reference's declared band; image: largest error of radiance and alpha;
    gradient_…: of each class of parameters."""
    around = crop(workload, size, MARGIN)
    lists = list_by_tile(project([around.surfels()], around.camera()), around.camera())
    near = np.unique(np.array(lists.surfel_from_pair))
    raw = {name: values[near] for name, values in workload.raw.items()}
    raw["radiance_sh"] = workload.features[near, :3] - 0.5
    part = crop(workload, size)
    case = Case("part", raw, part.pinhole, sky(), at="surfel", reflectance="radiance")
    row = measure_case(case, floors=False)
    found = {"order": row.order, "left_out": 1 - row.kept, "image": row.image, "maps": row.maps}
    return found | {f"gradient_{name}": row.gradients[name] for name in CLASSES}


COST = ("contributing", "pairs", "surfels")  # what time is linear in


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Everything that the page shows."""

    def shown(items: Iterable[Any], name: str) -> Iterable[Any]:
        return tqdm(list(items), desc=name, disable=quiet)

    workloads = [
        sphere(count, size, spread)
        for spread in settings.spreads
        for count in settings.surfels
        for size in settings.sizes
    ]
    gflops = measure_peak()
    rows = [case(workload, settings, gflops) for workload in shown(workloads, "cases")]
    wrong = [
        {"surfels": count, "size": size, "spread": spread}
        | compare(sphere(count, size, spread), settings.crop)
        for spread in settings.spreads
        for count, size in shown(settings.errors, f"errors at {spread:g}")
    ]
    dr.flush_malloc_cache()
    with ProcessPoolExecutor(1, get_context("spawn")) as fresh:  # whose memory is that of the step
        large = fresh.submit(large_step, *settings.large_step).result()
    return {
        "settings": asdict(settings),
        "gflops": gflops,
        "rows": rows,
        "cost": plane(rows, "both_ms", COST) if len(rows) > len(COST) + 1 else None,
        "errors": wrong,
        "large_step": large,
        "step": step_times(*settings.step, settings.steps),
    }


STEP_SECONDS = 1.0  # for which the splat of a step is timed by itself, at most


def step_times(surfels: int, size: int, steps: int) -> dict[str, Row]:
    """For every stage of the schedule: a step's time, launches, and where its time goes.

    Surfels cover a unit sphere; about half of them are seen. Each phase is timed between barriers, in steps
    of their own; `step_ms` is the wall time of undisturbed steps, less than the sum of the phases because
    kernels fuse across them; `splat_ms` that of the step's splat and its gradients by themselves."""
    trainer = make_trainer(surfels, sphere_data(size, 8, np.random.default_rng(0)))
    result = {}
    for name, stage in trainer.method.stages():
        if stage.shading.at == "pixel" and "mesh" in trainer.method.event:
            trainer.method.event["mesh"].apply(trainer)
        step, times = stepper(trainer, name), []
        phases = phases_of(step, max(steps // 3, 5))
        for _ in range(steps):
            begin = time.perf_counter()
            step()
            dr.sync_thread()
            times.append(1e3 * (time.perf_counter() - begin))
        splat_ms = timing.milliseconds({name: Ours.of_step(step).both}, STEP_SECONDS, steps)[name]
        result[name] = {
            "step_ms": round(float(np.median(times)), 2),
            "splat_ms": round(splat_ms, 2),
            "launches": sum(row["launches"] for row in phases),
            "phases_ms": {row["phase"]: round(row["ms"], 2) for row in phases},
        }
    return result


def case(workload: Workload, settings: Settings, gflops: float) -> Row:
    """One row: counts, times in turns, lower bounds."""
    count, size = workload.count, workload.pinhole.width
    full, colour = Ours.of(workload, FEATURES), Ours.of(workload, COLOUR)
    counts = full.counts()
    calls = {"forward": full.forward, "both": full.both}
    calls |= {"colour_forward": colour.forward, "colour_both": colour.both}
    slow = {}
    if (count, size) in settings.volprim:
        volprim = Volprim(workload)
        slow["volprim_forward"] = (volprim.forward, settings.volprim_repeats)
        slow["volprim_both"] = (volprim.both, settings.volprim_repeats)
    times = timing.milliseconds(calls, settings.seconds / len(calls), settings.repeats, slow)
    row: Row = {"spread": workload.spread, "surfels": count, "size": size}
    row |= {name: getattr(counts, name) for name in ("pairs", "evaluated", "contributing")}
    row["share"] = counts.contributing / counts.evaluated if counts.evaluated else 1.0
    row |= {f"{name}_ms": times.get(name) for name in (*calls, "volprim_forward", "volprim_both")}
    bound = {kind: 1e-6 * counts.contributing * flops / gflops for kind, flops in FLOPS.items()}
    return row | {f"bound_{kind}_ms": ms for kind, ms in bound.items()}


def plane(rows: Sequence[Row], target: str, names: Sequence[str]) -> dict[str, float]:
    """row[target] = constant + Σ c row[name], no coefficient negative, and the worst relative residual.

    Squares of relative residuals are summed, so that small cases count as much as large ones."""
    values = np.array([float(row[target]) for row in rows])
    design = np.array([[1.0, *(float(row[name]) for name in names)] for row in rows])
    scale = design.max(axis=0)  # keeps the solver's columns of one size
    solution, _ = nnls(design / scale / values[:, None], np.ones(len(rows)))
    found = solution / scale
    worst = np.abs(design @ found / values - 1).max()
    return {name: float(x) for name, x in zip(("constant", *names, "worst"), (*found, worst), strict=True)}


if __name__ == "__main__":
    sys.exit(benchmark("splatting", __doc__, measure, PAGE, SMALL))
