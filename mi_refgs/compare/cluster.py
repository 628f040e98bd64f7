"""Runs jobs on dask.distributed: on a cluster of this machine, or on the workers of a scheduler.

Workers must see the data sets and the comparison's folder under the same paths.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from mi_refgs.compare.execute import RETRIES, execute
from mi_refgs.compare.jobs import FAILED, Job
from mi_refgs.errors import InputError
from mi_refgs.runs.interrupt import held_interrupts

POLL = 0.5
"""Seconds between two looks at interrupts."""
CONNECT = "20s"
"""How long to wait for a scheduler."""


def run_on_cluster(
    jobs: Sequence[Job], address: str | None, workers: int, report: Callable[[Job, str | None], None]
) -> None:
    """Do jobs on the workers of the scheduler at `address`, or on `workers` of this machine without one.

    `report(job, reason)` is called for each that ended. A job whose worker died starts again from its
    checkpoint on another, RETRIES times at most; then its row says why.

    Raises InputError without dask.distributed and for a scheduler that does not answer; KeyboardInterrupt or
    TerminatedError after a signal, when the jobs have been called off.
    """
    distributed = _distributed()
    with held_interrupts() as release, _client(distributed, address, workers) as client:
        pending = {client.submit(execute, job, key=job.folder, pure=False): job for job in jobs}
        try:
            while pending:
                with contextlib.suppress(TimeoutError):
                    distributed.wait(list(pending), timeout=POLL, return_when="FIRST_COMPLETED")
                for future in [future for future in pending if future.done()]:
                    job = pending.pop(future)
                    report(job, _reason(job, future))
                release()
        finally:
            client.cancel(list(pending))  # what a scheduler of its own has not begun would outlive us


@contextlib.contextmanager
def _client(distributed: Any, address: str | None, workers: int) -> Iterator[Any]:
    """A client of the scheduler, or of a cluster of this machine that ends with it."""
    import dask

    limits = {"distributed.scheduler.allowed-failures": RETRIES, "distributed.comm.timeouts.connect": CONNECT}
    with dask.config.set(limits), contextlib.ExitStack() as stack:
        if address is None:
            cluster = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
            )
            address = stack.enter_context(cluster)
        try:
            client = distributed.Client(address)
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"--cluster: {address}: no scheduler answers there ({error}); start one"
            ) from error
        yield stack.enter_context(client)


def _reason(job: Job, future: Any) -> str | None:
    """None if a job is done, else why not, written into its run folder too."""
    error = future.exception()
    if error is None:
        reason: str | None = future.result()
        return reason
    reason = f"the cluster gave it up: {type(error).__name__}: {str(error).splitlines()[0]}"
    job.run.write_json(FAILED, {"reason": reason})
    return reason


def _distributed() -> Any:
    try:
        import distributed
    except ImportError as error:
        raise InputError(
            "--cluster: dask.distributed is not installed; pip install 'mi_refgs[cluster]'"
        ) from error
    return distributed
