"""Runs jobs, each in a process of its own: several at once on this machine, or on dask.distributed."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path

from mi_refgs.compare.jobs import FAILED, Job
from mi_refgs.compare.worker import DONE, FAILURE, GRACE
from mi_refgs.errors import InputError, require_package
from mi_refgs.io.files import cannot_write, read_json
from mi_refgs.runs.interrupt import held_interrupts

Report = Callable[[Job, str | None], None]  # of each job that ended: the reason is None if it is done
LOG = "job.log"  # of a run folder: output of its processes
RETRIES = 2  # restarts from the checkpoint of a job whose process was killed or crashed
POLL = 0.2  # seconds between checks of processes and interrupts


def execute(job: Job, stop: threading.Event | None = None) -> str | None:
    """Run a job; returns None if it is done or `stop` is set, else the reason, also written to failed.json.
    After a crash it continues from its checkpoint, at most RETRIES times."""
    if stop is not None and stop.is_set():
        return None
    job.write()
    for _ in range(1 + RETRIES):
        code = _process(job, stop)
        if code == DONE or (stop is not None and stop.is_set()):
            return None
        if code == FAILURE:
            return str(read_json(job.run.path / FAILED).get("reason"))
    saved = job.run.checkpoints()
    ended = f"was ended by {signal.Signals(-code).name}" if code < 0 else f"ended with exit code {code}"
    reason = (
        f"its process {ended} {1 + RETRIES} times, the last checkpoint being of iteration "
        f"{int(saved[-1].stem) if saved else 0}; {LOG} has what it printed"
    )
    job.run.write_json(FAILED, {"reason": reason})
    return reason


def execute_all(jobs: Sequence[Job], workers: int, report: Report, cluster: str | None = None) -> None:
    """Run jobs, `workers` at once, or on the scheduler at the address `cluster`, whose workers see the same
    paths. After a signal, raise when all processes have saved their state, or the cluster's are cancelled.
    Raises InputError without dask.distributed and for a scheduler that does not answer."""
    stop = threading.Event()
    local = contextlib.nullcontext(ThreadPoolExecutor(workers))
    with held_interrupts() as release, local if cluster is None else _cluster(cluster) as pool, pool:
        run = partial(execute, stop=stop) if cluster is None else execute
        pending = {pool.submit(run, job): job for job in jobs}
        try:
            while pending:
                done, _ = wait(pending, timeout=POLL, return_when=FIRST_COMPLETED)
                for future in done:
                    job, failure = pending.pop(future), future.exception()
                    if failure is None or cluster is None:
                        report(job, future.result())
                        continue
                    first = str(failure).splitlines()[0]
                    reason = f"the cluster gave it up: {type(failure).__name__}: {first}"
                    job.run.write_json(FAILED, {"reason": reason})
                    report(job, reason)
                release()
        except BaseException:
            stop.set()
            pool.shutdown(wait=False)  # what a scheduler has not begun would outlive us
            raise


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[Executor]:
    """The workers of a scheduler. A job whose worker died continues on another one, at most RETRIES times."""
    distributed, dask = (require_package(name, "cluster", "--cluster") for name in ("distributed", "dask"))
    limits = {"distributed.scheduler.allowed-failures": RETRIES, "distributed.comm.timeouts.connect": "20s"}
    with dask.config.set(limits):
        try:
            client = distributed.Client(address)
        except (OSError, ValueError, TimeoutError) as error:
            what = f"no scheduler answers there ({error})"
            raise InputError(what, "--cluster", address, "start one") from error
        with client:
            yield client.get_executor(pure=False)


def _process(job: Job, stop: threading.Event | None) -> int:
    package = str(Path(__file__).resolve().parents[2])
    paths = os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))
    try:
        log = (job.run.path / LOG).open("ab")
    except OSError as error:
        raise cannot_write(job.run.path / LOG, error) from error
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
        while stop is None or not stop.is_set():
            with contextlib.suppress(subprocess.TimeoutExpired):
                return process.wait(POLL)
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            return process.wait(GRACE)
        process.kill()
        return process.wait()
