"""Whether fits survive: killed at random moments, and over a hundred thousand steps.

    python -m benchmarks.survival kill --times 50       kills a fit again and again, and resumes it
    python -m benchmarks.survival soak --steps 100000   one long fit: memory, values not finite

Both fit the full method to a few images of 32² pixels with a few hundred surfels, on one thread, so that
checkpoints, logs, densifying, resets of opacity and mesh extraction recur within seconds. The exit code is 1
if a fit could not be resumed, lost more than an interval or left a half-written file, or if the long one grew
by more than 1 MB in 10,000 steps or met a value that is not finite.
"""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip

from benchmarks.common.fits import sphere_data
from benchmarks.common.report import plain_parser
from benchmarks.common.view import ROOT
from mi_refgs import methods
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.files import TEMPORARY, write_json
from mi_refgs.io.images import write_png
from mi_refgs.runs import checkpoint
from mi_refgs.runs.run import Run

SIZE, VIEWS = 32, 5
CHECKPOINT_EVERY = 4
"""Iterations between the checkpoints of the fits that are killed: most kills fall near one."""
WAIT = 1.5
"""A fit is killed at a random moment within so many seconds of its first log line."""
START_LIMIT = 300.0
"""Seconds in which a fit must get to its first step."""
GROWTH_LIMIT = 1.0
"""MB in 10,000 steps."""
INTERVAL = 1_000
"""Steps between the records of the soak."""
WARM_UP = 0.2
"""Share of the soak that slopes leave out: kernels are compiled and pools filled."""

COMMON = [
    "surfels.count=200",
    "surfels.max_count=300",
    "light.height=8",
    "mesh.resolution=16",
    "stage.initial.until=8",
    "log_every=1",
]


def settings(**windows: int) -> list[str]:
    """Assignments for a fit without end in which these events recur, each after so many iterations."""
    found = ["iterations=100_000_000", *COMMON]
    for name, every in windows.items():
        key = "mesh.extract" if name == "extract" else f"refine.{name}"
        found += [f"{key}.start=0", f"{key}.until=100_000_000", f"{key}.every={every}"]
    return found


def write_data(folder: Path) -> Path:
    """The images as a data set on disk."""
    folder.mkdir(parents=True)
    views: Any = sphere_data(SIZE, VIEWS, np.random.default_rng(0)).views
    frames = []
    for view in views:
        write_png(folder / f"{view.name}.png", np.dstack([view.image, view.alpha]))
        pose = view.to_world @ MITSUBA_FROM_OPENGL
        frames.append({"file_path": f"./{view.name}.png", "transform_matrix": pose.tolist()})
    content = {"fl_x": views[0].fx, "fl_y": views[0].fy, "w": SIZE, "h": SIZE, "frames": frames}
    write_json(folder / "transforms_train.json", content)
    return folder


# ---------------- killed ----------------


def kill(times: int, seed: int, folder: Path) -> dict[str, Any]:
    """Start or resume a fit, kill it at a random moment, look at what it left; `times` times.

    Every second kill waits, after its random moment, for the next checkpoint that is being written.
    """
    draw, run = random.Random(seed), Run(folder / "run")
    data = write_data(folder / "data")
    again = [sys.executable, "-m", "mi_refgs", "train", str(data), "-o", str(run.path), "--resume"]
    again += ["--threads", "1"]
    windows = settings(densify=7, extract=9, reset=50)
    windows += [f"checkpoint_every={CHECKPOINT_EVERY}", "preview_every=6"]
    first = [*again, "--preset", "quick", "--set", *windows]
    outcomes: list[dict[str, Any]] = []
    for number in range(times + 1):
        # Start, or resume, and wait until it goes on.
        command = again if (run.path / "config.toml").exists() else first
        before, resumed, last = _logged(run), _checkpoint(run), number == times
        environment, pipe = os.environ | {"PYTHONPATH": str(ROOT)}, subprocess.PIPE
        process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.DEVNULL, stderr=pipe, env=environment)
        deadline = time.monotonic() + START_LIMIT
        while process.poll() is None and time.monotonic() < deadline and not _goes_on(run, before, resumed):
            time.sleep(0.01)
        # Kill it.
        if process.poll() is None:
            time.sleep(draw.uniform(0, WAIT))
        aimed = number % 2 == 1 and not last
        while aimed and process.poll() is None and time.monotonic() < deadline and not _writing(run):
            pass
        process.send_signal(signal.SIGTERM if last else signal.SIGKILL)
        _, said = process.communicate()
        killed = process.returncode == (143 if last else -signal.SIGKILL)
        # What it left.
        reached, damaged = _logged(run), []
        for path in run.checkpoints():
            try:
                checkpoint.read(path)
            except checkpoint.DamagedError as error:
                damaged.append(f"{path.name}: {error}")
        outcomes.append(
            {
                "kill": number,
                "signal": "SIGTERM" if last else "SIGKILL",
                "while_writing": aimed,
                "resumed_at": resumed,
                "reached": reached,
                "lost": reached - _checkpoint(run),
                "damaged": damaged,
                "temporary": sum(1 for path in run.path.rglob(".*") if TEMPORARY.fullmatch(path.name)),
                "ok": killed and not damaged and reached > resumed,
                "said": "" if killed else said.decode(errors="replace")[-500:],
            }
        )
        print(json.dumps(outcomes[-1]), file=sys.stderr, flush=True)
    lost, left = max(outcome["lost"] for outcome in outcomes), outcomes[-1]["temporary"]
    return {
        "seed": seed,
        "kills": times,
        "resumed": sum(outcome["ok"] for outcome in outcomes[1:]),
        "most_iterations_lost": lost,
        "checkpoint_every": CHECKPOINT_EVERY,
        "damaged_checkpoints": sum(len(outcome["damaged"]) for outcome in outcomes),
        "temporary_files_at_the_end": left,
        "ok": all(outcome["ok"] for outcome in outcomes) and lost <= CHECKPOINT_EVERY and not left,
    }


def _logged(run: Run) -> int:
    """Iteration of the last whole line of the log; 0 without one."""
    try:
        lines = (run.path / "metrics.jsonl").read_bytes().split(b"\n")[:-1]
        return int(json.loads(lines[-1])["iteration"])
    except (OSError, ValueError, IndexError):
        return 0


def _checkpoint(run: Run) -> int:
    """Iteration of the newest checkpoint; 0 without one."""
    return max((int(path.stem) for path in run.checkpoints()), default=0)


def _writing(run: Run) -> bool:
    """Whether a checkpoint is being written."""
    return any(entry.name.startswith(".") for entry in os.scandir(run.path / "checkpoints"))


def _goes_on(run: Run, before: int, resumed: int) -> bool:
    """Whether a fit has made a step since it was started: the log was cut back to `resumed`, then grew."""
    now = _logged(run)
    return resumed < now != before or (now > resumed == before)


# ---------------- soaked ----------------


def soak(steps: int, folder: Path, output: Path | None) -> dict[str, Any]:
    """One fit of so many steps; a record every INTERVAL steps is printed and, at the end, all are written."""
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    assignments = settings(densify=100, extract=500, reset=2_000)
    assignments += [f"iterations={steps}", "log_every=50", "checkpoint_every=1_000"]
    method = methods.load("ref_gaussian", "quick", assignments)
    run = Run(folder / "run")
    run.create(method, "none")
    trainer = Trainer(method, sphere_data(SIZE, VIEWS, np.random.default_rng(0)), run)
    records: list[dict[str, Any]] = []

    def record(state: Trainer) -> None:
        if state.iteration % INTERVAL:
            return
        state.view(state.targets[0].camera)  # as a preview does
        records.append(
            {
                "step": state.iteration,
                "rss_mb": round(psutil.Process().memory_info().rss / 2**20, 3),
                "surfels": state.surfels.count,
                "skipped": state.health.skipped,
                "not_finite": sum(int((~np.isfinite(x)).sum()) for x in state.state().values()),
                "loss": round(float(state.loss[0]), 5),
            }
        )
        print(json.dumps(records[-1]), file=sys.stderr, flush=True)

    trainer.train(record)
    kept = records[int(WARM_UP * len(records)) :]
    step, memory = np.array([(r["step"], r["rss_mb"]) for r in kept], np.float64).T
    growth = 1e4 * float(np.polyfit(step, memory, 1)[0]) if len(kept) > 1 else 0.0  # by least squares
    skipped, bad = trainer.health.skipped, sum(r["not_finite"] for r in records)
    result = {
        "steps": trainer.iteration,
        "rss_mb": [kept[0]["rss_mb"], kept[-1]["rss_mb"]],
        "rss_mb_per_10000_steps": round(growth, 3),
        "skipped_steps": skipped,
        "not_finite": bad,
        "ok": growth <= GROWTH_LIMIT and not skipped and not bad,
    }
    if output is not None:
        write_json(output, {"result": result, "records": records})
    return result


def main(arguments: list[str] | None = None) -> int:
    """Run one of the two and print its result as JSON."""
    parser = plain_parser("survival", __doc__)
    parser.add_argument("what", choices=("kill", "soak"))
    parser.add_argument("--times", type=int, default=50, help="kills")
    parser.add_argument("--steps", type=int, default=100_000)
    parser.add_argument("--seed", type=int, default=0, help="of the moments of the kills")
    parser.add_argument("-o", "--output", type=Path, help="file for all records of the soak")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        if options.what == "kill":
            result = kill(options.times, options.seed, Path(folder))
        else:
            result = soak(options.steps, Path(folder), options.output)
    print(json.dumps(result, indent=2))
    return 0 if result["ok"] else 1


if __name__ == "__main__":
    sys.exit(main())
