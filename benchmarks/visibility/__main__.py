"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       the page docs/visibility.md
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.md, images/visibility_*.png, visibility.csv and visibility.json to the output folder;
without -o, the page and its picture go to docs/ and the two others to runs/.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.lights import ROOT
from benchmarks.common.report import write_csv, write_json, write_text
from mi_refgs.errors import InputError


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; exit code 2 for bad input."""
    mi.set_variant("llvm_ad_rgb")
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.visibility",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--small", action="store_true", help="a coarse instance, below a minute")
    parser.add_argument("--mesh", metavar="FILE", action="append", default=[], help="a mesh; repeatable")
    parser.add_argument("-o", "--output", type=Path, help="folder; without it docs/ and runs/")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write page and picture of this earlier run"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    options = parser.parse_args(arguments)

    from benchmarks.visibility.measure import measure
    from benchmarks.visibility.page import page
    from benchmarks.visibility.plots import plot
    from benchmarks.visibility.settings import PAGE, SMALL

    settings = replace(SMALL if options.small else PAGE, meshes=tuple(options.mesh))
    folder, data = (options.output,) * 2 if options.output else (ROOT / "docs", ROOT / "runs")
    try:
        if options.json:
            result = json.loads(options.json.read_text(encoding="utf-8"))
        else:
            result = measure(settings, options.quiet)
        write_json(data / "visibility.json", result)
        write_csv(data / "visibility.csv", result["rows"])
        write_text(folder / "visibility.md", page(result, plot(result, folder / "images"), folder))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(folder / "visibility.md")
    return 0


if __name__ == "__main__":
    sys.exit(main())
