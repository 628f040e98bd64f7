"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       every scene, four minutes on 2 cores
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.json; `python -m benchmarks.pages` makes the tables and the plot of docs/visibility.md."""

from __future__ import annotations

import sys

from benchmarks.common.report import benchmark
from benchmarks.visibility.cases import PAGE, SMALL
from benchmarks.visibility.measure import measure

if __name__ == "__main__":
    sys.exit(benchmark("visibility", __doc__, measure, PAGE, SMALL, ("--mesh", "meshes")))
