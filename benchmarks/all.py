"""Measure everything that the pages show, one part after the other; leave the machine alone meanwhile.

    python -m benchmarks.all --data FOLDER --list       the parts, their times, and what is measured already
    python -m benchmarks.all --data FOLDER              measure what is missing, and write the pages
    python -m benchmarks.all --only splatting images
    python -m benchmarks.all --small -o out             small instances; no page is written

FOLDER contains chair_400/ (NeRF-Synthetic), meshes/bob_tri.obj and lat-long maps in envmaps/. A part whose
result, benchmarks/results/NAME.json, is of the present commit is not repeated, nor is a finished fit: the
same command continues an interrupted run."""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi

from benchmarks import pages, plots
from benchmarks.common.build import RESULTS, commit, recorded, write_result
from benchmarks.common.report import plain_parser
from benchmarks.common.view import ROOT
from benchmarks.fits.measure import Workplace, group
from benchmarks.fits.plan import GROUPS, TIMED, Fit
from benchmarks.tables import PAGES
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file, read_json


@dataclass(frozen=True)
class Part:
    """A data file, and the module with arguments that measures it.

    {data} is --data, {run} the run of TIMED. Modules of `tables.PAGES` write their file themselves;
    others print JSON, which becomes `result`. Groups of fits have no module."""

    name: str
    minutes: float  # on an idle machine with two cores
    module: str = ""
    small: str | None = None  # arguments of a small instance


TRACING = {"front": 5, "decisions": 20, "photographs": 14}  # minutes of path tracing in a group


def _fits() -> Iterator[Part]:
    done: set[Fit] = set()  # a fit of two groups is measured once
    for name, fits in GROUPS.items():
        minutes = sum(fit.minutes for fit in {*fits} - done) + TRACING.get(name, 0)
        yield Part(name, round(minutes), small="")
        done |= {*fits}


PARTS = (
    Part("splatting", 5, "benchmarks.splatting", "--small"),
    Part("splitsum", 9, "benchmarks.splitsum", "--small"),
    Part("visibility", 4, "benchmarks.visibility --mesh {data}/meshes/bob_tri.obj", "--small"),
    Part("endtoend", 4, "benchmarks.endtoend", "--small"),
    Part("stability", 15, "benchmarks.stability", "--quick --only light"),
    *_fits(),
    Part("frames", 2, "benchmarks.frames {run}"),
)
"""In this order: those with {run} need groups of fits."""


def main(arguments: list[str] | None = None) -> int:
    """Measure; exit code 1 if a part fails, 2 for bad input."""
    parser = plain_parser("all", __doc__)
    names = [part.name for part in PARTS]
    parser.add_argument("--list", action="store_true", help="print the plan only")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help="these parts")
    parser.add_argument("--small", action="store_true", help="small instances; requires -o")
    parser.add_argument("-o", "--output", type=Path, help="folder of the results of --small")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="data that is not made here")
    options = parser.parse_args(arguments)
    if options.small != bool(options.output):
        parser.error("--small: -o: give both, or none of the two")
    mi.set_variant("llvm_ad_rgb")
    folder, build = (options.output or RESULTS).resolve(), commit()
    chosen = [part for part in PARTS if part.name in options.only]
    if options.small:
        chosen = [part for part in chosen if part.small is not None]
    left = [part for part in chosen if not is_done(folder / f"{part.name}.json", build)]
    for part in chosen:
        print(f"{part.name:<15}{part.minutes:>4} min  {'to do' if part in left else 'done'}")
    print(f"{'in all':<15}{sum(part.minutes for part in left):>4} min, commit {build}", flush=True)
    if options.list:
        return 0
    failed = [part.name for part in left if not run(part, options, folder)]
    if failed:
        print(f"failed: {' '.join(failed)}; the same command repeats only them", file=sys.stderr)
    code = 0 if options.small else plots.main([]) or pages.main([])
    return code or int(bool(failed))


def is_done(path: Path, build: str) -> bool:
    """Whether a data file is of this build."""
    return is_file(path) and read_json(path)["build"]["commit"] == build


def run(part: Part, options: argparse.Namespace, folder: Path) -> bool:
    """Measure a part, and print how long it took; returns whether that succeeded."""
    begin, work = time.monotonic(), folder / "work" if options.small else Path("runs", "all")
    words = part.module.format(data=options.data, run=work / commit() / TIMED.name / "run").split()
    words += (part.small or "").split() if options.small else []
    writes = part.name in PAGES  # its data file itself
    if writes:
        words += ["--quiet", *(["-o", str(folder)] if options.small else [])]

    def measure() -> dict[str, Any]:
        if part.name in GROUPS:
            return group(part.name, Workplace(ROOT / work, options.data, options.small))
        done = subprocess.run([sys.executable, "-m", *words], cwd=ROOT, stdout=subprocess.PIPE, text=True)
        if done.returncode:
            raise InputError(f"python -m {' '.join(words)}: exit code {done.returncode}; see above")
        return {} if writes else {"result": json.loads(done.stdout)}

    print(f"{part.name} …", flush=True)
    try:
        if options.data is None and "{data}" in part.module and not options.small:
            raise InputError(f"{part.name}: --data: missing; give the folder")
        found = recorded(measure)
        if not writes:
            write_result(folder / f"{part.name}.json", found)
    except InputError as error:
        print(error, file=sys.stderr, flush=True)
        return False
    print(f"{part.name}: {(time.monotonic() - begin) / 60:.1f} min", flush=True)
    return True


if __name__ == "__main__":
    sys.exit(main())
