"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       every scene, four minutes on 2 cores
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.json; `python -m benchmarks.pages` makes the tables and the plot of docs/visibility.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.common.report import make_parser, write_measured
from benchmarks.visibility.cases import PAGE, SMALL
from benchmarks.visibility.measure import measure


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 2 for bad input."""
    parser = make_parser("visibility", __doc__, PAGE, SMALL)
    parser.add_argument("--mesh", metavar="FILE", action="append", default=[], help="a mesh; repeatable")
    options = parser.parse_args(arguments)
    settings = replace(options.settings, meshes=tuple(options.mesh))
    return write_measured("visibility", options, lambda: measure(settings, options.quiet))


if __name__ == "__main__":
    sys.exit(main())
