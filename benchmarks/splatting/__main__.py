"""Times, work, memory and errors of the splatter, against other renderers and the machine's limits.

    python -m benchmarks.splatting                     the page docs/splatting.md, in five minutes on 2 cores
    python -m benchmarks.splatting --scene runs/glossy the same, with the surfels of a fitted scene
    python -m benchmarks.splatting --small -o out      a small instance, below a minute
    python -m benchmarks.splatting --full              slow renderers in more cases, everything more often

Writes splatting.md, images/splatting_*.png, splatting.csv and splatting.json to the output folder; without
-o, the page and its pictures go to docs/ and the two others to runs/.
"""

from __future__ import annotations

import sys
from dataclasses import replace

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.command import make_parser, write_reports


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 2 for bad input."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    parser = make_parser("splatting", __doc__)
    size = parser.add_mutually_exclusive_group()
    size.add_argument("--small", action="store_true", help="a coarse instance, below a minute")
    size.add_argument("--full", action="store_true", help="more repeats, and more cases of slow renderers")
    parser.add_argument(
        "--scene", metavar="RUN", action="append", default=[], help="run folder of a fit; repeatable"
    )
    options = parser.parse_args(arguments)

    from benchmarks.splatting.measure import measure
    from benchmarks.splatting.page import page
    from benchmarks.splatting.plots import plot
    from benchmarks.splatting.settings import FULL, PAGE, SMALL

    settings = replace(
        SMALL if options.small else FULL if options.full else PAGE, scenes=tuple(options.scene)
    )

    return write_reports("splatting", options, lambda: measure(settings, options.quiet), plot, page)


if __name__ == "__main__":
    sys.exit(main())
