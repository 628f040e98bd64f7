"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       the page docs/visibility.md
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.md, images/visibility_*.png and visibility.json to the output folder;
without -o, the page and its image go to docs/ and the JSON to benchmarks/results/.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.common.report import make_parser, write_reports
from benchmarks.visibility.cases import PAGE, SMALL
from benchmarks.visibility.measure import measure
from benchmarks.visibility.page import page, plot


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 2 for bad input."""
    parser = make_parser("visibility", __doc__, PAGE, SMALL)
    parser.add_argument("--mesh", metavar="FILE", action="append", default=[], help="a mesh; repeatable")
    options = parser.parse_args(arguments)
    settings = replace(options.settings, meshes=tuple(options.mesh))
    return write_reports("visibility", options, lambda: measure(settings, options.quiet), plot, page)


if __name__ == "__main__":
    sys.exit(main())
