"""Times, work, memory and errors of the splatter, against other renderers and the machine's limits.

    python -m benchmarks.splatting                     the page docs/splatting.md, in five minutes on 2 cores
    python -m benchmarks.splatting --scene runs/glossy the same, with the surfels of a fitted scene
    python -m benchmarks.splatting --small -o out      a small instance, below a minute

Writes splatting.md, images/splatting_*.png and splatting.json to the output folder; without
-o, the page and its images go to docs/ and the JSON to benchmarks/results/.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.common.report import make_parser, write_reports
from benchmarks.splatting.cases import PAGE, SMALL
from benchmarks.splatting.measure import measure
from benchmarks.splatting.page import page, plot


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 2 for bad input."""
    parser = make_parser("splatting", __doc__, PAGE, SMALL)
    parser.add_argument(
        "--scene", metavar="RUN", action="append", default=[], help="run folder of a fit; repeatable"
    )
    options = parser.parse_args(arguments)
    settings = replace(options.settings, scenes=tuple(options.scene))
    return write_reports("splatting", options, lambda: measure(settings, options.quiet), plot, page)


if __name__ == "__main__":
    sys.exit(main())
