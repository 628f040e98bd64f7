"""Times, work and errors of the splatter, against other renderers and the machine's limits.

    python -m benchmarks.splatting                     every case, in five minutes on 2 cores
    python -m benchmarks.splatting --small -o out      a small instance, below a minute

Writes splatting.json; `python -m benchmarks.pages` makes the tables and the plot of docs/splatting.md."""

from __future__ import annotations

import sys

from benchmarks.common.report import benchmark
from benchmarks.splatting.cases import PAGE, SMALL
from benchmarks.splatting.measure import measure

if __name__ == "__main__":
    sys.exit(benchmark("splatting", __doc__, measure, PAGE, SMALL))
