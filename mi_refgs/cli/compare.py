"""`refgs compare`: methods fitted to the same data sets, and their table."""

import dataclasses
import itertools
import os
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional

from mi_refgs.cli.command import METHODS, Output, Preset, Rendering, Result, Settings, optional, separated
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError, require_between
from mi_refgs.io.progress import say

if TYPE_CHECKING:
    from mi_refgs.compare.jobs import Job


@dataclass(frozen=True, kw_only=True)
class Compare:
    """The same command continues an interrupted comparison. Without DATA, the table is made again.

    example:
      refgs compare data/glossy --methods ref_gaussian base_2dgs --seeds 0 1 -o runs/compare"""

    data: Annotated[Positional[tuple[Path, ...]], optional("DATA …")] = ()  # data sets
    output: Output  # folder of the comparison
    methods: Annotated[tuple[str, ...], optional("NAME|FILE.toml …", help=f"{METHODS}, or files")] = ()
    seeds: Annotated[tuple[str, ...], optional("K …")] = ()  # seeds of the fits (default: 0)
    preset: Preset = None
    set: Settings = ()
    workers: Annotated[int | None, optional("N", "(default: 1)")] = None
    """simultaneous jobs, which share the cores"""
    cluster: Annotated[str | None, optional("ADDRESS")] = None
    """run the jobs by dask.distributed, on a scheduler whose workers must see the same folders"""
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.compare import execute, jobs
        from mi_refgs.compare.table import TABLE, TABLE_TEXT, markdown, write

        if self.data:
            workers = 1 if self.workers is None else self.workers
            cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
            require_between(workers, "--workers", 1, 4 * cores)
            share = None if workers == 1 else max(cores // workers, 1)
            # The jobs, checked and written into their run folders.
            methods = separated(self.methods)
            if not methods:
                raise InputError("none given", "--methods", remedy=f"name some of {METHODS}")
            try:
                seeds = [int(seed) for seed in separated(self.seeds) or ["0"]]
            except ValueError as error:
                what = f"{' '.join(self.seeds)}: not integers"
                raise InputError(what, "--seeds", remedy="write them as 0 1") from error
            shared: dict[str, Any] = {"preset": self.preset or DEFAULT_PRESET, "settings": sum(self.set, ())}
            shared["mitsuba_variant"] = self.common.mitsuba_variant
            shared["threads"] = self.common.threads or share
            shared["plugins"] = tuple(str(file.absolute()) for file in self.common.plugin)
            planned = jobs.plan(self.output, self.data, methods, seeds, **shared)
            jobs.begin(self.output, planned, workers, sys.argv[1:])
            wanted = [job for job in planned if not jobs.finished(job)]
            say(f"{self.output}: {len(wanted)} of {len(planned)} jobs to do, {workers} at once")
            begin, numbers = time.perf_counter(), itertools.count(1)

            def report(job: "Job", reason: str | None) -> None:
                outcome = "done" if reason is None else f"failed: {reason}"
                minutes = (time.perf_counter() - begin) / 60
                number = f"[{next(numbers)}/{len(wanted)}]"
                say(f"{number} after {minutes:.1f} min: {job.title}: {outcome}")

            try:
                execute.execute_all(wanted, workers, report, self.cluster)
            except KeyboardInterrupt as error:
                raise type(error)(f"interrupted; the same command continues, from {self.output}") from None
        else:
            given = vars(self) | {"threads": self.common.threads}
            for name in ("methods", "seeds", "preset", "set", "workers", "cluster", "threads"):
                if given[name] not in (None, ()):
                    remedy = "name the data sets to which to fit the methods"
                    raise InputError("none given", f"--{name}", "DATA", remedy)
        table = write(self.output)
        files = ", ".join(str(self.output / name) for name in (TABLE_TEXT, TABLE))
        return Result(dataclasses.asdict(table), f"{markdown(table)}\n{files}", 0 if table.complete else 3)
