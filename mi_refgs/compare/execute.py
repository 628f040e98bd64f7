"""Runs jobs, each in a process of its own, one after the other or several at once."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from pathlib import Path

from mi_refgs.compare.jobs import FAILED, Job
from mi_refgs.compare.worker import DONE, FAILURE, GRACE
from mi_refgs.errors import InputError
from mi_refgs.io.files import cannot_write, read_json
from mi_refgs.runs.interrupt import held_interrupts

LOG = "job.log"
"""File of a run folder: what its processes printed."""
RETRIES = 2
"""How often a job whose process was killed or crashed starts again from its checkpoint."""
POLL = 0.2
"""Seconds between two looks at a process."""


def execute(job: Job, stop: threading.Event | None = None) -> str | None:
    """Do a job; returns None if it is done, else why not, which failed.json says too.

    A process that a signal ended, as a crash does, starts again from its checkpoint, RETRIES times at most.
    With `stop` set, the process is asked to save its state and to end; that counts as done here.

    Raises InputError if the run folder cannot be written.
    """
    if stop is not None and stop.is_set():
        return None
    job.write()
    code = DONE
    for _ in range(1 + RETRIES):
        code = _process(job, stop)
        if code == DONE or (stop is not None and stop.is_set()):
            return None
        if code == FAILURE:
            return str(read_json(Path(job.folder) / FAILED).get("reason"))
    saved = job.run.checkpoints()
    ended = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    reason = (
        f"its process {ended} {1 + RETRIES} times, the last checkpoint being of iteration "
        f"{int(saved[-1].stem) if saved else 0}; {LOG} has what it printed"
    )
    job.run.write_json(FAILED, {"reason": reason})
    return reason


def execute_all(jobs: Sequence[Job], workers: int, report: Callable[[Job, str | None], None]) -> None:
    """Do jobs, `workers` at once; `report(job, reason)` is called for each that ended.

    Raises KeyboardInterrupt or TerminatedError after a signal, when all processes have saved their state.
    """
    stop = threading.Event()
    with held_interrupts() as release, ThreadPoolExecutor(workers) as pool:
        pending = {pool.submit(execute, job, stop): job for job in jobs}
        try:
            while pending:
                done, _ = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                for future in done:
                    report(pending.pop(future), future.result())
                release()
        except BaseException:
            stop.set()
            raise


def _process(job: Job, stop: threading.Event | None) -> int:
    """The exit code of one process that works on a job."""
    package = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
    try:
        log = job.run.output.own(LOG).open("ab")
    except OSError as error:
        raise cannot_write(Path(job.folder) / LOG, error) from error
    with log:
        process = subprocess.Popen(
            [sys.executable, "-m", "mi_refgs.compare.worker", job.folder],
            stdin=subprocess.PIPE,  # closes with this process
            stdout=log,
            stderr=log,
            env=os.environ | {"PYTHONPATH": paths},
            start_new_session=True,  # Ctrl-C reaches this process alone, which passes it on
        )
    with process:
        while True:
            try:
                return process.wait(POLL)
            except subprocess.TimeoutExpired:
                if stop is not None and stop.is_set():
                    break
        process.terminate()
        try:
            return process.wait(GRACE)
        except subprocess.TimeoutExpired:
            process.kill()
            return process.wait()


def threads_each(workers: int, threads: int | None) -> int | None:
    """Threads of each of `workers` processes: those asked for, or an equal share of the cores.

    Raises InputError if there are fewer than one worker.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not 1 <= workers <= 4 * cores:
        raise InputError(f"--workers: {workers} is out of range; give 1 to {4 * cores}")
    if threads is not None or workers == 1:
        return threads
    return max(cores // workers, 1)
