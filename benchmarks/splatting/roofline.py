"""What the machine can do at most, measured with small kernels; and models of what a view asks of it.

FLOPs of a contributing pair, counted by hand from the formulas, an exponential as 12: forward about 36 for
the footprint and 24 for compositing; forward and backward 260, where the footprint is evaluated twice.
Evaluations that do not contribute, sorting and memory are not in it, so `contributing · flops / peak` is a
lower bound of the time of any renderer of these surfels.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi

from benchmarks.common.timing import once
from mi_refgs.profiling.profile import Counts
from mi_refgs.surfels.primitives.surfel import Surfel

FLOPS = {"forward": 60, "both": 260}
CHAINS = 16
"""Independent sums a lane: more than latency times ports of any CPU's multiply-add unit."""
STEPS = 4096
PACKETS = 256
"""Packets of 16 lanes: enough blocks for every thread."""
TRIES = 12
FLOAT = 4  # bytes
LISTED_BYTES = 24
"""A listed pair's surfel, tile and depth, written once and read once; a sort's passes are not in it."""


def measure_peaks(triad: int) -> dict[str, float]:
    """Multiply-add rate in GFLOP/s, and triad bandwidth in GB/s (two reads and a write) on all threads.

    The best of some tries: a limit is what nothing exceeds.
    """
    factors = [dr.opaque(mi.Float, 0.5 + 0.01 * i) for i in range(CHAINS)]
    steps = dr.opaque(mi.UInt32, STEPS)
    a, b = (dr.opaque(mi.Float, x, triad) for x in (1.0, 2.0))
    lanes = PACKETS * 16 * dr.thread_count()

    def multiply_add() -> Any:
        def body(i: Any, sums: list[Any]) -> Any:
            return i + 1, [dr.fma(s, factor, factor) for s, factor in zip(sums, factors, strict=True)]

        lane = dr.arange(mi.Float, lanes)
        state = (dr.zeros(mi.UInt32, lanes), [lane + k for k in range(CHAINS)])
        _, sums = dr.while_loop(state, lambda i, sums: i < steps, body, label="peak")
        return sum(sums, mi.Float(0))

    def add() -> Any:
        return dr.fma(b, factors[0], a)

    fma, moved = (min(once(call) for _ in range(TRIES)) for call in (multiply_add, add))
    return {"gflops": 2e-9 * lanes * STEPS * CHAINS / fma, "gbytes": 1e-9 * 3 * FLOAT * triad / moved}


def bytes_moved(counts: Counts, features: int) -> dict[str, int]:
    """Bytes that a view must load and store at least, most of them from caches.

    Forward: what is listed; an index and a row of geometry and features for each visited pair; the maps.
    Backward again the rows and the maps with their adjoints, and a read and a write of a row of adjoints for
    each visited pair (a bound from above: not every visited pair contributes).
    """
    row = FLOAT * (Surfel.columns + features)
    maps = FLOAT * (features + 2) * counts.pixels
    forward = LISTED_BYTES * counts.pairs + (FLOAT + row) * counts.visited + maps
    return {"forward": forward, "both": forward + (FLOAT + 3 * row) * counts.visited + 2 * maps}


def lower_bound(counts: Counts, gflops: float) -> dict[str, float]:
    """Milliseconds below which no renderer gets at this rate."""
    return {kind: 1e-6 * counts.contributing * flops / gflops for kind, flops in FLOPS.items()}
