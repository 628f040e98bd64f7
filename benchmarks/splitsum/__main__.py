"""Speed against error of the split-sum approximation, with Mitsuba's path tracer beside it.

    python -m benchmarks.splitsum                      the page docs/splitsum.md, below 10 minutes on 2 cores
    python -m benchmarks.splitsum --small -o out       a small instance, below a minute
    python -m benchmarks.splitsum --envmap sky.exr --shape sphere -o out   your light beside the built-in ones

Writes splitsum.md, images/splitsum_*.png and splitsum.json to the output folder; without -o,
the page and its images go to docs/ and the JSON to benchmarks/results/.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.common.report import make_parser, write_reports
from benchmarks.common.view import BUILT_IN
from benchmarks.splitsum.measure import measure
from benchmarks.splitsum.page import page, plot
from benchmarks.splitsum.setup import CONVEX, PAGE, SMALL


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 2 for bad input."""
    parser = make_parser("splitsum", __doc__, PAGE, SMALL)
    parser.add_argument(
        "--envmap", metavar="FILE", action="append", default=[], help="another light; repeatable"
    )
    parser.add_argument(
        "--light", action="append", choices=BUILT_IN, help="only these built-in lights; repeatable"
    )
    parser.add_argument("--shape", action="append", choices=CONVEX, help="only these shapes; repeatable")
    parser.add_argument("--size", type=int, help="edge of the images whose error is measured, pixels")
    options = parser.parse_args(arguments)
    settings = options.settings
    settings = replace(settings, lights=(*(options.light or settings.lights), *options.envmap))
    if options.shape:
        settings = replace(settings, shapes=tuple(options.shape), budget_shapes=tuple(options.shape))
    if options.size:
        settings = replace(settings, size=options.size)
    return write_reports("splitsum", options, lambda: measure(settings, options.quiet), plot, page)


if __name__ == "__main__":
    sys.exit(main())
