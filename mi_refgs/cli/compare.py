"""`refgs compare`: methods side by side on the same data sets, with tables, plots and a page."""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, add_settings, say
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError

if TYPE_CHECKING:
    from mi_refgs.compare.jobs import Job

EXIT_INCOMPLETE = 3
"""Exit code of a comparison in which a job failed: its row says why, the others are there."""
EXAMPLE = "refgs compare data/glossy --variants ref_gaussian,base_2dgs --seeds 0,1 -o runs/compare"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "fit data sets with several methods, and set the results side by side"
    parser = add_command(commands, "compare", summary, EXAMPLE, run)
    parser.add_argument(
        "data",
        type=Path,
        nargs="*",
        metavar="DATA",
        help="data sets; without any, the table of what the folder holds is made again",
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FOLDER",
        help="folder of the comparison; the same command goes on where it stopped",
    )
    parser.add_argument(
        "--variants", nargs="+", metavar="V", help="methods: names or .toml files, by spaces or commas"
    )
    parser.add_argument("--seeds", nargs="+", metavar="K", help="as in 0,1 (default 0)")
    parser.add_argument(
        "--preset", metavar="P", help=f"quick, standard or paper: how long (default {DEFAULT_PRESET})"
    )
    add_settings(parser)
    parser.add_argument(
        "--workers", type=int, metavar="N", help="jobs at once, which share the cores (default 1)"
    )
    parser.add_argument(
        "--cluster",
        nargs="?",
        const="",
        metavar="ADDRESS",
        help="run the jobs on dask.distributed: on the scheduler at ADDRESS, whose workers must see the same "
        "folders, or on N workers of this machine",
    )


def run(args: argparse.Namespace) -> Result:
    """Do what is left to do, then make the table of all runs in the folder."""
    from mi_refgs.compare import cluster, execute, jobs, results

    if args.output is None:
        raise InputError("-o: none given; name the folder of the comparison")
    if args.data:
        workers = 1 if args.workers is None else args.workers
        planned = _plan(args, workers, execute.threads_each(workers, args.threads))
        wanted = [job for job in planned if not jobs.finished(job)]
        say(f"{args.output}: {len(wanted)} of {len(planned)} jobs to do, {workers} at once")
        try:
            if args.cluster is None:
                execute.execute_all(wanted, workers, Report(len(wanted)))
            else:
                cluster.run_on_cluster(wanted, args.cluster or None, workers, Report(len(wanted)))
        except KeyboardInterrupt as error:
            raise type(error)(f"interrupted; the same command goes on, from {args.output}") from None
    else:
        _require_unused(args, "DATA: none given; name the data sets that the methods are to be fitted to")
    table = results.write(args.output)
    text = results.text(args.output, table)
    return Result(dataclasses.asdict(table), text, 0 if table.complete else EXIT_INCOMPLETE)


def _plan(args: argparse.Namespace, workers: int, threads: int | None) -> list[Job]:
    from mi_refgs.compare import jobs, results
    from mi_refgs.methods import names

    variants = _separated(args.variants or [])
    if not variants:
        raise InputError(f"--variants: none given; name some of {', '.join(names())}")
    try:
        seeds = [int(seed) for seed in _separated(args.seeds or ["0"])]
    except ValueError as error:
        raise InputError(f"--seeds: {' '.join(args.seeds)}: not whole numbers; write them as 0,1") from error
    preset = args.preset or DEFAULT_PRESET
    planned = jobs.plan(
        args.output, args.data, variants, seeds, preset, args.set, args.mitsuba_variant, threads
    )
    results.begin(args.output, planned, workers, sys.argv[1:])
    return planned


def _require_unused(args: argparse.Namespace, reason: str) -> None:
    """Raise InputError for an option that only a fit honours."""
    for name in ("variants", "seeds", "preset", "set", "workers", "cluster", "threads"):
        if getattr(args, name) not in (None, []):
            raise InputError(f"--{name}: {reason}")


def _separated(values: list[str]) -> list[str]:
    return [part for value in values for part in value.split(",") if part]


class Report:
    """A line on standard error for each job that ended."""

    def __init__(self, count: int) -> None:
        self.count, self.done, self.begin = count, 0, time.perf_counter()

    def __call__(self, job: Job, reason: str | None) -> None:
        self.done += 1
        minutes = (time.perf_counter() - self.begin) / 60
        outcome = "done" if reason is None else f"failed: {reason}"
        say(f"[{self.done}/{self.count}] after {minutes:.1f} min: {job.title}: {outcome}")
