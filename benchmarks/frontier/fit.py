"""One cell in a process of its own, whose row is printed as JSON: python -m benchmarks.frontier.fit CELL."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from subprocess import SubprocessError

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip
import mitsuba as mi  # isort: skip
import numpy as np

from benchmarks.common.report import Row
from benchmarks.common.timing import in_fresh_process, peak_bytes
from benchmarks.frontier.cells import SCORES, Cell
from mi_refgs.data.dataset import Dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.fitting.runner import begin
from mi_refgs.fitting.train import Trainer
from mi_refgs.runs.run import Run
from mi_refgs.runs.views import read_views

HOLDOUT = 8
"""Every so many training views, the first included, are validation views: not fitted, but scored."""


def measure(cell: Cell, seconds: float | None = None) -> Row:
    """Fit a cell in a fresh process; a row with only `failed`, the reason, if that is impossible."""
    try:
        return in_fresh_process("benchmarks.frontier.fit", json.dumps(asdict(cell)), seconds=seconds)
    except SubprocessError as error:
        return {"failed": f"its process ended early ({error})"}


def fitted(cell: Cell) -> Row:
    """Fit a cell to the training views without validation views, and score those at full size.

    The clocks run from the fit's set-up (visual hull, initial surfels) to its last step; reading images and
    scoring are outside. Raises InputError as `read_dataset` and `begin` do.
    """
    method, path = cell.resolved(), Path(cell.data)
    training, _ = read_views(method, path, "train", truth=False).held_out(HOLDOUT)
    _, validation = read_views(method.downscaled(1), path, "train", decode=False).held_out(HOLDOUT)
    if not training.views:
        raise InputError(f"{path}: one training view; give 2 or more, of which one is a validation view")
    with tempfile.TemporaryDirectory() as folder:
        cpu, wall = time.process_time(), time.perf_counter()
        trainer = begin(method, training, Run(Path(folder) / "run"))
        trainer.train()
        dr.sync_thread()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        peak = peak_bytes()
    first, full = training.views[0], validation.views[0]
    return {
        "cpu_seconds": cpu,
        "wall_seconds": wall,
        "peak_bytes": peak,
        "surfels": sum(table.surfels.count for table in trainer.fit.tables),
        **scores(trainer, validation),
        "width": first.width,
        "height": first.height,
        "full_width": full.width,
        "full_height": full.height,
        "views": len(training.views),
        "validation_views": len(validation.views),
    }


def scores(trainer: Trainer, data: Dataset) -> Row:
    """Return the mean SCORES of the present state over the views of a data set."""
    found: dict[str, list[float]] = {name: [] for name in SCORES}
    for view in data.views:
        view = view.load()
        rendered = RenderedView.of(trainer.view(view.camera()), data, view)
        found["psnr"].append(metrics.psnr(rendered.image, view.displayed))
        found["ssim"].append(metrics.ssim(rendered.image, view.displayed))
        if view.normal is not None:
            errors = metrics.normal_mae_deg(rendered.normal, view.normal, view.covered())
            found["normal_mae_deg"].append(errors["normal_mae_deg"])
    return {name: float(np.mean(values)) if values else None for name, values in found.items()}


def main(text: str) -> None:
    """Print the row of a cell, given as JSON; {"failed": why} for one that cannot be fitted."""
    cell = Cell(**json.loads(text))
    if cell.threads is not None:
        dr.set_thread_count(cell.threads)
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    try:
        row = fitted(cell)
    except InputError as error:
        row = {"failed": str(error)}
    print(json.dumps(row))


if __name__ == "__main__":
    main(sys.argv[1])
