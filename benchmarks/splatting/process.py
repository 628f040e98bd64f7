"""What only a fresh process can tell: peak memory, and how long kernels take to compile.

python -m benchmarks.splatting.process memory 50000 256
"""

from __future__ import annotations

import json
import sys
import tempfile
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from benchmarks.common.timing import forget_peak, in_fresh_process, once, peak_bytes

SPREAD = 1.5
STEPS = 3
TINY = (64, 16)
"""Surfels and pixels that compile a view's kernels, so that the compiler's own memory is not counted."""


def measure_compile(case: tuple[int, int]) -> dict[str, Any]:
    """Milliseconds of the first forward and the first forward + backward: kernel cache empty, full, warm."""
    with tempfile.TemporaryDirectory() as folder:
        cold, cached = (measure("compile", case, DRJIT_CACHE_DIR=folder) for _ in range(2))
    found = {"cold": cold["first"], "cached": cached["first"], "warm": cached["second"]}
    return {"surfels": case[0], "size": case[1]} | found


def measure(task: str, case: tuple[int, int], **environment: str) -> dict[str, Any]:
    """Run a task in a fresh process, for a number of surfels and a size of the image.

    memory: peak of forward and backward; step: peak and time of training steps; compile: first calls.
    """
    return in_fresh_process("benchmarks.splatting.process", task, *case, environment=environment)


# ---------------- in the fresh process ----------------


def _memory(count: int, size: int) -> dict[str, Any]:
    from benchmarks.splatting.cases import FEATURES, sphere
    from benchmarks.splatting.renderers import Ours

    dr.eval(Ours.of(sphere(*TINY, SPREAD), FEATURES).both())
    workload = sphere(count, size, SPREAD)
    before = _start()
    ours = Ours.of(workload, FEATURES)
    for _ in range(STEPS):
        dr.eval(ours.both())
        dr.sync_thread()
    result = _peaks(before)
    counts = ours.counts()
    return {"surfels": count, "size": size, "pixels": size**2, "pairs": counts.pairs} | result


def _step(count: int, size: int) -> dict[str, Any]:
    import numpy as np

    from benchmarks.common.fits import make_trainer, sphere_data

    trainer = make_trainer(count, sphere_data(size, 2, np.random.default_rng(0)))
    trainer.extract_mesh()
    before = _start()
    trainer.fit.iteration = trainer.method.stages()[-1][1].until - STEPS - 1
    times = [1e3 * once(trainer.step) for _ in range(STEPS + 1)]
    whole = peak_bytes()
    found = {"surfels": trainer.surfels.count, "size": size, "ms": float(np.median(times[1:]))}
    return found | _peaks(before) | {"whole_process": whole}


def _compile(count: int, size: int) -> dict[str, Any]:
    from benchmarks.splatting.cases import FEATURES, sphere
    from benchmarks.splatting.renderers import Ours

    ours = Ours.of(sphere(count, size, SPREAD), FEATURES)
    calls = {"forward": ours.forward, "both": ours.both}
    return {turn: {kind: 1e3 * once(call) for kind, call in calls.items()} for turn in ("first", "second")}


def _start() -> int:
    """Forget earlier peaks; the memory that the process has now."""
    dr.sync_thread()
    dr.flush_malloc_cache()
    dr.detail.malloc_clear_statistics()
    return forget_peak()


def _peaks(before: int) -> dict[str, int]:
    """Bytes since `_start`: what the process grew by at most, and what Dr.Jit's allocator held at most."""
    backend = dr.JitBackend.LLVM
    return {"peak": peak_bytes() - before, "allocated": int(dr.detail.malloc_watermark(backend))}


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    tasks = {"memory": _memory, "step": _step, "compile": _compile}
    print(json.dumps(tasks[sys.argv[1]](int(sys.argv[2]), int(sys.argv[3]))))
