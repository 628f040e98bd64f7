"""Times, work and errors of the splatter, against other renderers and the machine's limits.

    python -m benchmarks.splatting                     every case, in five minutes on 2 cores
    python -m benchmarks.splatting --small -o out      a small instance, below a minute

Writes splatting.json; `python -m benchmarks.pages` makes the tables and the plot of docs/splatting.md.
"""

from __future__ import annotations

import sys

from benchmarks.common.report import make_parser, write_measured
from benchmarks.splatting.cases import PAGE, SMALL
from benchmarks.splatting.measure import measure


def main(arguments: list[str] | None = None) -> int:
    """Measure; returns the exit code, 2 for bad input."""
    options = make_parser("splatting", __doc__, PAGE, SMALL).parse_args(arguments)
    return write_measured("splatting", options, lambda: measure(options.settings, options.quiet))


if __name__ == "__main__":
    sys.exit(main())
