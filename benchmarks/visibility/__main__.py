"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       the page docs/visibility.md
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.md, images/visibility_*.png, visibility.csv and visibility.json to the output folder;
without -o, the page and its picture go to docs/ and the two others to runs/.
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
    parser = make_parser("visibility", __doc__)
    parser.add_argument("--small", action="store_true", help="a coarse instance, below a minute")
    parser.add_argument("--mesh", metavar="FILE", action="append", default=[], help="a mesh; repeatable")
    options = parser.parse_args(arguments)

    from benchmarks.visibility.measure import measure
    from benchmarks.visibility.page import page
    from benchmarks.visibility.plots import plot
    from benchmarks.visibility.settings import PAGE, SMALL

    settings = replace(SMALL if options.small else PAGE, meshes=tuple(options.mesh))

    return write_reports("visibility", options, lambda: measure(settings, options.quiet), plot, page)


if __name__ == "__main__":
    sys.exit(main())
