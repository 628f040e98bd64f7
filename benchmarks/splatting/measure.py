"""The experiment: every case by every renderer in turns, what it asks of the machine, how wrong it is."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import drjit as dr
import numpy as np
from scipy.optimize import nnls
from tqdm import tqdm

from benchmarks.common import report, timing
from benchmarks.splatting import errors, process, roofline
from benchmarks.splatting.ours import Ours
from benchmarks.splatting.settings import Settings
from benchmarks.splatting.volprim import Volprim
from benchmarks.splatting.workload import COLOUR, FEATURES, Workload, fitted, sphere
from benchmarks.step import step_times

PHASES = ("project", "tile lists", "sort", "splat forward", "splat backward", "surfels backward")
PHASE_REPEATS = 5
MEMORY = ("surfels", "pairs", "pixels")
"""What peak memory is linear in."""
COST = ("contributing", "pairs", "surfels")
"""What time is linear in."""
Row = dict[str, Any]


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Everything that the page shows."""
    begin = time.perf_counter()

    def shown(items: Iterable[Any], name: str) -> Iterable[Any]:
        return tqdm(list(items), desc=name, disable=quiet)

    workloads = [
        sphere(count, size, spread)
        for spread in settings.spreads
        for count in settings.surfels
        for size in settings.sizes
    ] + [fitted(folder) for folder in settings.scenes]
    peaks = roofline.measure_peaks(settings.triad)
    rows = [case(workload, settings, peaks) for workload in shown(workloads, "cases")]
    spheres = [row for row in rows if row["spread"] is not None]
    wrong = [
        {"surfels": count, "size": size, "spread": spread}
        | errors.compare(sphere(count, size, spread), settings.crop)
        for spread in settings.spreads
        for count, size in shown(settings.errors, f"errors at {spread:g}")
    ]
    dr.flush_malloc_cache()
    memory = [process.measure_memory(one) for one in shown(settings.memory, "memory")]
    result = {
        "settings": asdict(settings),
        "machine": report.machine(),
        "peaks": peaks,
        "rows": rows,
        "cost": plane(spheres, "both_ms", COST) if len(spheres) > len(COST) + 1 else None,
        "errors": wrong,
        "memory": memory,
        "memory_fit": plane(memory, "peak", MEMORY) if len(memory) > len(MEMORY) + 1 else None,
        "large_step": process.measure_step(settings.large_step),
        "compile": process.measure_compile(settings.compiled),
        "step": step_times(*settings.step, settings.steps),
    }
    return result | {"seconds": time.perf_counter() - begin}


def case(workload: Workload, settings: Settings, peaks: dict[str, float]) -> Row:
    """One row: counts, times in turns, phases, launches, lower bounds."""
    count, size = workload.count, workload.pinhole.width
    full, colour = Ours.of(workload, FEATURES), Ours.of(workload, COLOUR)
    counts = full.counts()
    calls = {
        "forward": full.forward,
        "both": full.both,
        "colour_forward": colour.forward,
        "colour_both": colour.both,
    }
    slow = {}
    if workload.spread is None or (count, size) in settings.volprim:
        volprim = Volprim(workload)
        slow["volprim_forward"] = (volprim.forward, settings.volprim_repeats)
        slow["volprim_both"] = (volprim.both, settings.volprim_repeats)
    times = timing.milliseconds(calls, settings.seconds / len(calls), settings.repeats, slow)
    launches = {kind: full.launches(getattr(full, kind)) for kind in ("forward", "both")}
    bound = roofline.lower_bound(counts, peaks["gflops"])
    moved = roofline.bytes_moved(counts, FEATURES)
    phases = full.phases(min(PHASE_REPEATS, settings.repeats))
    row: Row = {"case": workload.name, "spread": workload.spread, "surfels": count, "size": size}
    names = ("pixels", "covered", "pairs", "evaluated", "contributing", "share")
    row |= {name: getattr(counts, name) for name in names}
    row |= {f"{name}_ms": times.get(name) for name in (*calls, "volprim_forward", "volprim_both")}
    row |= {f"{phase.replace(' ', '_')}_ms": phases[phase] for phase in PHASES}
    for kind in ("forward", "both"):
        row |= {f"bound_{kind}_ms": bound[kind], f"bytes_{kind}": moved[kind]}
        row |= {f"launches_{kind}": launches[kind][0], f"misses_{kind}": launches[kind][1]}
    return row


def plane(rows: Sequence[Row], target: str, names: Sequence[str]) -> dict[str, float]:
    """row[target] = constant + Σ c row[name], no coefficient negative; R², and the worst relative residual.

    Squares of relative residuals are summed, so that small cases count as much as large ones.
    """
    values = np.array([float(row[target]) for row in rows])
    design = np.array([[1.0, *(float(row[name]) for name in names)] for row in rows])
    scale = design.max(axis=0)  # keeps the solver's columns of one size
    solution, _ = nnls(design / scale / values[:, None], np.ones(len(rows)))
    found = solution / scale
    residual = design @ found - values
    return {
        "constant": float(found[0]),
        **{name: float(value) for name, value in zip(names, found[1:], strict=True)},
        "r2": 1 - float(np.sum(residual**2) / np.sum((values - values.mean()) ** 2)),
        "worst": float(np.abs(residual / values).max()),
    }
