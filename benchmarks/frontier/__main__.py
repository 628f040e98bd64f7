"""Validation PSNR of fits against their CPU time, over surfels, iterations, image sizes and samples.

    python -m benchmarks.frontier chair scenes/mirror_ring.xml     data sets, or scenes that are path-traced
    python -m benchmarks.frontier chair --seeds 0 1 --threads 1 -o out
    python -m benchmarks.frontier --json FILE                  the page and the plot of an earlier result

Every combination of the options is a cell, and so is every shipped preset: one fit in a process of its own.
Every eighth training view is a validation view, which is not fitted but scored at full size. The file of a
cell in --cells is written atomically, and an interrupted run continues; results of other data, code or
machines are not used.
Writes frontier.md, images/frontier.png and frontier.json; without -o, the page and its plot go
to docs/ and the JSON to benchmarks/results/.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip

from benchmarks.common.report import Row, make_parser, write_reports
from benchmarks.common.view import ROOT
from benchmarks.frontier.cells import Axes, Cell, Store
from benchmarks.frontier.fit import measure
from benchmarks.frontier.page import page, plot
from mi_refgs import __version__, methods
from mi_refgs.errors import InputError
from mi_refgs.synthesis.make_dataset import make_dataset

INTERRUPTED = 130
"""Exit code after Ctrl-C."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = make_parser("frontier", __doc__)
    made.add_argument("data", nargs="*", type=Path, metavar="DATA", help="data set, or SCENE.xml")
    made.add_argument("--cells", type=Path, default=ROOT / "runs" / "frontier", help="folder of the cells")
    made.add_argument("--methods", nargs="+", default=["ref_gaussian"], metavar="NAME|FILE.toml")
    made.add_argument("--presets", nargs="*", default=["quick", "standard"], choices=methods.PRESETS)
    for option, default, text in (
        ("surfels", [5_000, 20_000, 60_000], "largest numbers of surfels; 3/4 of them at the start"),
        ("iterations", [500, 1_000, 2_000], "lengths, to which methods are scaled as to a preset"),
        ("downscale", [1], "pixels of a file per pixel of a fit, along a side"),
        ("samples", [1], "per pixel, in the steps of a fit"),
        ("seeds", [0], "of each setting"),
    ):
        made.add_argument(f"--{option}", nargs="*", type=int, default=default, metavar="N", help=text)
    made.add_argument("--threads", type=int, metavar="N", help="of each fit; all cores without it")
    made.add_argument("--size", type=int, default=200, help="pixels per side of the images of a SCENE.xml")
    return made


def main(arguments: list[str] | None = None) -> int:
    """Measure, and write the reports; the exit code, 2 for bad input."""
    made = parser()
    options = made.parse_args(arguments)
    if not options.data and options.json is None:
        made.error("DATA: missing; give data sets, or scenes of scenes/")
    if options.threads is not None:
        dr.set_thread_count(options.threads)
    try:
        return write_reports("frontier", options, lambda: measured(options), plot, page)
    except KeyboardInterrupt:
        print(f"interrupted; {options.cells} has the finished cells: run the same again", file=sys.stderr)
        return INTERRUPTED


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Return the rows of all cells, stored ones included.

    Raises InputError for bad data, methods and options, and if no cell has a result.
    """
    data = [data_set(path, options) for path in options.data]
    names = ("methods", "presets", "iterations", "surfels", "downscale", "samples", "seeds")
    cells = Axes(data=data, **{name: getattr(options, name) for name in names}).cells(options.threads)
    store, say = Store(options.cells), _printer(options.quiet)
    if unused := store.unused(cells):
        say(f"{options.cells}: {unused} files of other settings, data, code or machines are not used")
    rows, failed = run(cells, store, say)
    if not rows:
        raise InputError(f"DATA: no cell has a result; the first: {failed[0]['failed']}" if failed else
                         "DATA: no cells; give --presets, or --surfels and --iterations")  # fmt: skip
    return {
        "version": __version__,
        "code": store.code,
        "rows": rows,
        "failed": failed,
        "seconds": sum(row["wall_seconds"] for row in rows),
    }


def run(cells: Iterable[Cell], store: Store, say: Any) -> tuple[list[Row], list[Row]]:
    """Measure the cells that are not stored; returns the rows of all, and the cells without a result."""
    rows: list[Row] = []
    failed: list[Row] = []
    rehearsed: set[Cell] = set()
    for cell in cells:
        row = store.read(cell)
        if row is None:
            rehearsal = cell.rehearsal()
            if rehearsal not in rehearsed:
                rehearsed.add(rehearsal)
                measure(rehearsal)
            row = measure(cell)
            if "failed" in row:
                failed.append({"cell": cell.title, **row})
                say(f"{cell.title}: {row['failed']}")
                continue
            row = cell.described() | row
            store.write(cell, row)
        rows.append(row)
        say(f"{cell.title}: {row['psnr']:.2f} dB in {row['cpu_seconds']:.0f} CPU s")
    return rows, failed


def data_set(path: Path, options: argparse.Namespace) -> Path:
    """Return the folder of a data set; that of a SCENE.xml is path-traced below --cells, or continued."""
    if path.suffix != ".xml":
        return path
    target = options.cells / "data" / f"{path.stem}_{options.size}"
    return make_dataset(path, target, size=options.size, progress=not options.quiet)


def _printer(quiet: bool) -> Any:
    return (lambda _: None) if quiet else (lambda text: print(text, file=sys.stderr, flush=True))


if __name__ == "__main__":
    sys.exit(main())
