"""The experiment: every case by every renderer in turns, what it asks of the machine, how wrong it is."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import drjit as dr
from tqdm import tqdm

from benchmarks.common import report
from benchmarks.splatting import errors, fits, limits, process, raster
from benchmarks.splatting.ours import Ours
from benchmarks.splatting.settings import Settings
from benchmarks.splatting.turns import turns
from benchmarks.splatting.volprim import Volprim
from benchmarks.splatting.workload import COLOUR, FEATURES, Workload, fitted, sphere
from benchmarks.step import step_times

BASELINE = Path(__file__).with_name("baseline.json")
PHASES = ("project", "bin", "sort", "blend", "adjoint", "scatter", "project backward")
STAGE_REPEATS = 5
MEMORY = ("surfels", "pairs", "pixels")
"""What peak memory is linear in."""
COST = ("contributing", "pairs", "surfels")
"""What time is linear in."""
Row = dict[str, Any]


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Everything that the page shows."""
    begin = time.perf_counter()
    workloads = [
        sphere(count, size, spread)
        for spread in settings.spreads
        for count in settings.surfels
        for size in settings.sizes
    ] + [fitted(folder) for folder in settings.scenes]
    peaks = limits.measure_peaks(settings.triad)
    rows = [case(workload, settings, peaks) for workload in _shown(workloads, "cases", quiet)]
    wrong = [
        {"surfels": count, "size": size, "spread": spread}
        | errors.compare(sphere(count, size, spread), settings.crop)
        for spread in settings.spreads
        for count, size in _shown(settings.errors, f"errors at {spread:g}", quiet)
    ]
    dr.flush_malloc_cache()
    memory = [process.measure_memory((one,))[0] for one in _shown(settings.memory, "memory", quiet)]
    result = {
        "settings": asdict(settings),
        "machine": report.machine(),
        "peaks": peaks,
        "rows": rows,
        "fits": time_fits(rows),
        "fits_by_surfels": {
            f"{count:,}": time_fits([row for row in rows if row["surfels"] == count])["both"]
            for count in settings.surfels
        },
        "cost": fits.plane(_spheres(rows), "both_ms", COST) if len(rows) > len(COST) + 1 else None,
        "errors": wrong,
        "memory": memory,
        "memory_fit": fits.plane(memory, "peak", MEMORY) if len(memory) > len(MEMORY) + 1 else None,
        "large_step": process.measure_step(settings.large_step) if settings.large_step else None,
        "compile": [
            {"surfels": count, "size": size} | process.measure_compile((count, size))
            for count, size in settings.compiled
        ],
        "step": {"surfels": settings.step[0], "size": settings.step[1]}
        | {"stages": step_times(*settings.step, settings.steps)},
        "baseline": json.loads(BASELINE.read_text(encoding="utf-8")),
    }
    return result | {"seconds": time.perf_counter() - begin}


def _shown(items: Iterable[Any], name: str, quiet: bool) -> Iterable[Any]:
    return tqdm(list(items), desc=name, disable=quiet)


def case(workload: Workload, settings: Settings, peaks: dict[str, float]) -> Row:
    """One row: counts, times in turns, stages, launches, limits."""
    count, size = workload.count, workload.pinhole.width
    full, colour = Ours.of(workload, FEATURES), Ours.of(workload, COLOUR)
    counts = full.counts()
    calls: dict[str, tuple[Callable[[], Any], int]] = {
        "forward": (full.forward, settings.repeats),
        "both": (full.both, settings.repeats),
        "colour_forward": (colour.forward, settings.repeats),
        "colour_both": (colour.both, settings.repeats),
    }
    scene = workload.spread is None
    if scene or (count, size) in settings.volprim:
        volprim = Volprim(workload)
        calls["volprim_forward"] = (volprim.forward, settings.volprim_repeats)
        calls["volprim_both"] = (volprim.both, settings.volprim_repeats)
    if scene or (count, size) in settings.raster:
        calls["raster_forward"] = (lambda: raster.forward(workload, FEATURES), settings.raster_repeats)
    times = turns(calls, settings.seconds / 4)
    launches = {kind: full.launches(getattr(full, kind)) for kind in ("forward", "both")}
    bound = limits.lower_bound(counts, peaks["gflops"])
    moved = limits.bytes_moved(counts, FEATURES)
    stages = full.stages(min(STAGE_REPEATS, settings.repeats))
    row: Row = {
        "case": workload.name,
        "spread": workload.spread,
        "surfels": count,
        "size": size,
        "pixels": counts.pixels,
        "covered": counts.covered,
        "pairs": counts.pairs,
        "evaluated": counts.evaluated,
        "contributing": counts.contributing,
        "share": counts.share,
    }
    kinds = ("forward", "both")
    for name in ("", "colour_", "volprim_", "raster_"):
        row |= {f"{name}{kind}_ms": times.get(f"{name}{kind}") for kind in kinds}
    row |= {f"{stage}_ms": stages[stage] for stage in PHASES}
    row |= {f"bound_{kind}_ms": bound[kind] for kind in kinds}
    row |= {f"bytes_{kind}": moved[kind] for kind in kinds}
    row |= {f"launches_{kind}": launches[kind][0] for kind in kinds}
    return row | {f"misses_{kind}": launches[kind][1] for kind in kinds}


def time_fits(rows: list[Row]) -> dict[str, dict[str, float]]:
    """Lines of time over contributing pairs, of the spheres: whole passes, and the two kernels alone."""
    found = _spheres(rows)
    x = [row["contributing"] for row in found]
    kernels = [row["blend_ms"] + row["adjoint_ms"] for row in found]
    return {
        "forward": fits.line(x, [row["forward_ms"] for row in found]),
        "both": fits.line(x, [row["both_ms"] for row in found]),
        "kernels": fits.line(x, kernels),
    }


def _spheres(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["spread"] is not None]
