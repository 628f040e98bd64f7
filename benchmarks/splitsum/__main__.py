"""Speed against error of the split-sum approximation, with Mitsuba's path tracer beside it.

    python -m benchmarks.splitsum                      every case, below 10 minutes on 2 cores
    python -m benchmarks.splitsum --small -o out       a small instance, below a minute
    python -m benchmarks.splitsum --envmap sky.exr -o out   your light beside the built-in ones

Writes splitsum.json; `python -m benchmarks.pages` makes the tables and the plot of docs/splitsum.md."""

from __future__ import annotations

import sys

from benchmarks.common.report import benchmark
from benchmarks.splitsum.measure import measure
from benchmarks.splitsum.setup import PAGE, SMALL

if __name__ == "__main__":
    sys.exit(benchmark("splitsum", __doc__, measure, PAGE, SMALL, ("--envmap", "lights")))
