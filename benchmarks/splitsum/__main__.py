"""Speed against error of the split-sum approximation, with Mitsuba's path tracer beside it.

    python -m benchmarks.splitsum                      every case, below 10 minutes on 2 cores
    python -m benchmarks.splitsum --small -o out       a small instance, below a minute
    python -m benchmarks.splitsum --envmap sky.exr -o out   your light beside the built-in ones

Writes splitsum.json; `python -m benchmarks.pages` makes the tables and the plot of docs/splitsum.md.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.common.report import make_parser, write_measured
from benchmarks.splitsum.measure import measure
from benchmarks.splitsum.setup import PAGE, SMALL


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 2 for bad input."""
    parser = make_parser("splitsum", __doc__, PAGE, SMALL)
    parser.add_argument(
        "--envmap", metavar="FILE", action="append", default=[], help="another light; repeatable"
    )
    options = parser.parse_args(arguments)
    settings = replace(options.settings, lights=(*options.settings.lights, *options.envmap))
    return write_measured("splitsum", options, lambda: measure(settings, options.quiet))


if __name__ == "__main__":
    sys.exit(main())
