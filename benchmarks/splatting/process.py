"""A training step's time and memory in a process of its own: python -m benchmarks.splatting.process N SIZE"""

from __future__ import annotations

import json
import sys
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip
import numpy as np

from benchmarks.common.fits import make_trainer, sphere_data
from benchmarks.common.timing import once, peak_bytes

STEPS = 3


def step(count: int, size: int) -> dict[str, Any]:
    """Return milliseconds per step of the full method's last stage, and the largest resident memory."""
    trainer = make_trainer(count, sphere_data(size, 2, np.random.default_rng(0)))
    trainer.method.event["mesh"].apply(trainer)
    trainer.fit.iteration = trainer.method.stages()[-1][1].until - STEPS - 1
    times = [1e3 * once(trainer.step) for _ in range(STEPS + 1)]
    found = {"surfels": trainer.surfels.count, "size": size, "ms": float(np.median(times[1:]))}
    return found | {"whole_process": peak_bytes()}


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    print(json.dumps(step(int(sys.argv[1]), int(sys.argv[2]))))
