"""One job in a separate process, whose crash is a row: `python -m mi_refgs.compare.worker RUN`. The process
saves its state and ends when its standard input closes, which means that its parent is gone. Exit codes: 0
done, 2 failed (failed.json has the reason), 143 stopped."""

import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path

from mi_refgs.compare.jobs import FAILED, Job
from mi_refgs.errors import InputError
from mi_refgs.io.progress import say, warn
from mi_refgs.registry import load_plugins
from mi_refgs.runs.interrupt import TerminatedError
from mi_refgs.runs.run import Run

DONE, FAILURE, STOPPED = 0, 2, 143  # exit codes
PATIENCE = 60.0  # seconds to wait for an earlier process to leave the folder
GRACE = 30.0  # seconds between SIGTERM and the end of this process by force


def main(folder: Path) -> int:
    """Run the job of a run folder; returns the exit code."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with Run(folder).alone(PATIENCE):
            job = Job.read(folder)
            (folder / FAILED).unlink(missing_ok=True)
            fit_and_measure(job)
        return DONE
    except KeyboardInterrupt:
        return STOPPED
    except InputError as error:
        reason = str(error)
    except Exception as error:
        traceback.print_exc()
        reason = f"{type(error).__name__}: {error} (job.log has the details)"
    say(reason)
    Job.read(folder).run.write_json(FAILED, {"reason": reason})
    return FAILURE


def fit_and_measure(job: Job) -> None:
    """Train from the newest checkpoint, if any, to the end; then write artefacts and metrics."""
    import drjit as dr
    import mitsuba as mi

    if job.threads is not None:
        dr.set_thread_count(job.threads)
    mi.set_variant(job.mitsuba_variant)
    mi.set_log_level(mi.LogLevel.Warn)
    load_plugins(job.plugins)
    from mi_refgs.evaluation.evaluate import evaluate
    from mi_refgs.fitting.runner import begin, finish
    from mi_refgs.runs.views import read_views

    run, data = job.run, Path(job.data)
    method = run.method() if run.exists() else job.method()
    trainer = begin(method, read_views(method, data, "train", truth=False), run, warn=warn)
    if trainer.iteration:
        say(f"resumed at iteration {trainer.iteration} of {method.iterations}")
    trainer.train()
    finish(trainer, run)
    evaluate(run, data)


def _end_with_parent() -> None:
    """Send SIGTERM to this process when its standard input closes, and end it by force after GRACE."""
    while os.read(0, 1):  # not sys.stdin: its lock would be held when the interpreter ends
        pass
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(GRACE)
    os._exit(STOPPED)


if __name__ == "__main__":

    def _terminated(*_: object) -> None:
        raise TerminatedError

    signal.signal(signal.SIGTERM, _terminated)
    sys.exit(main(Path(sys.argv[1])))
