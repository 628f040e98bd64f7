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
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi

from benchmarks import pages, plots
from benchmarks.common.build import RESULTS, commit, recorded, write_result
from benchmarks.common.report import plain_parser
from benchmarks.common.view import ROOT
from benchmarks.fits import DECIDED, GROUPS, TIMED, Workplace, group
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file, read_json


@dataclass(frozen=True)
class Part:
    """A data file, and what measures it: a group of fits, or the module of this name.

    In its arguments, {data} is --data, {run} the run of TIMED, {runs} are those of DECIDED."""

    name: str
    minutes: float  # on an idle machine with two cores
    arguments: str = ""


TRACING = {"images": 20, "photographs": 14}  # minutes of path tracing in a group


PARTS = (
    Part("splatting", 5),
    Part("splitsum", 9),
    Part("visibility", 4, "--mesh {data}/meshes/bob_tri.obj"),
    Part("endtoend", 4),
    Part("stability", 15),
    *(
        Part(name, round(sum(fit.minutes for fit in fits)) + TRACING.get(name, 0))
        for name, fits in GROUPS.items()
    ),
    Part("frames", 2, "--run {run}"),
    Part("oracle", 20, "{runs}"),
)
"""In this order: those with {run} or {runs} need groups of fits."""


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
    chosen = [part for part in chosen if not (options.small and "{run" in part.arguments)]
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
    folders = {fit: work / commit() / fit.name / "run" for fit in DECIDED}
    runs = " ".join(f"--run {path}" for path in folders.values())
    arguments = part.arguments.format(data=options.data, run=folders[TIMED], runs=runs).split()
    words = [f"benchmarks.{part.name}", "--quiet", "-o", str(folder)]
    words += ["--small"] if options.small else arguments
    print(f"{part.name} …", flush=True)
    try:
        if options.data is None and "{data}" in part.arguments and not options.small:
            raise InputError(f"{part.name}: --data: missing; give the folder")
        if part.name in GROUPS:
            place = Workplace(ROOT / work, options.data, options.small)
            write_result(folder / f"{part.name}.json", recorded(lambda: group(part.name, place)))
        elif code := subprocess.run([sys.executable, "-m", *words], cwd=ROOT).returncode:
            raise InputError(f"python -m {' '.join(words)}: exit code {code}; see above")
    except InputError as error:
        print(error, file=sys.stderr, flush=True)
        return False
    print(f"{part.name}: {(time.monotonic() - begin) / 60:.1f} min", flush=True)
    return True


if __name__ == "__main__":
    sys.exit(main())
