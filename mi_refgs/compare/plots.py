"""Plots of a comparison, and crops of the region in which its methods differ most; all PNG."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.compare.table import Row, Scene
from mi_refgs.compare.worker import CURVE
from mi_refgs.errors import InputError
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.evaluation.images import contact_sheet
from mi_refgs.fitting.targets import read_views
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import read_png, write_png
from mi_refgs.runs.run import Run

AXES = (("seconds", "training (s)"), ("iteration", "iterations"))
"""Key of a line of a curve, and the axis' title."""
STYLES, DPI = ("-", "--", ":"), 140
"""Line styles, the next one for every ten methods; pixels per inch, twice those of a common screen."""
CROP_VIEWS = 16
"""Test views that are searched for the crop, evenly spread."""
CROP_SHARE, CROP_MIN = 3, 24
"""A crop is so small a part of the picture's shorter side, but no fewer pixels."""
ROW = 6
"""Crops side by side."""


# ---------- curves ----------


def write_curves(folder: Path, scene: Scene, path: Path) -> bool:
    """Plot PSNR on test views over seconds and over iterations as PNG; False if no run has a curve.

    One colour a method, one line a seed. Raises InputError if the file cannot be written.
    """
    lines = [(row, read_curve(folder / run)) for row in scene.rows for run in row.runs]
    lines = [(row, curve) for row, curve in lines if curve]
    if not lines:
        return False
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9, 3.4), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    names = [row.variant for row in scene.rows]
    look: dict[str, dict[str, Any]] = {
        name: {"color": f"C{i % 10}", "linestyle": STYLES[i // 10 % 3]} for i, name in enumerate(names)
    }
    for axes, (key, title) in zip(figure.subplots(1, 2, sharey=True), AXES, strict=True):
        for row, curve in lines:
            x, y = [point[key] for point in curve], [point["psnr"] for point in curve]
            axes.plot(x, y, marker=".", linewidth=1.2, **look[row.variant])
        axes.set_xlabel(title)
        axes.grid(alpha=0.3)
    figure.axes[0].set_ylabel("PSNR (dB)")
    handles = [figure.axes[0].plot([], [], **look[name])[0] for name in names]
    figure.legend(handles, names, loc="outside right center", frameon=False)
    buffer = BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_bytes(path, buffer.getvalue())
    return True


def read_curve(run: Path) -> list[dict[str, Any]]:
    """The points of a run's curve, without half a line that a killed process may leave."""
    try:
        lines = (run / CURVE).read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    points = []
    for line in lines:
        try:
            point = json.loads(line)
            points.append({key: float(point[key]) for key in ("iteration", "seconds", "psnr")})
        except (ValueError, KeyError, TypeError):
            continue
    return points


# ---------- crops ----------


@dataclass(frozen=True)
class Region:
    """A square of a test view: its upper left pixel and its side."""

    view: str
    row: int
    column: int
    side: int


def write_crops(folder: Path, scene: Scene, path: Path) -> Region | None:
    """Write the truth and each method's render (first seed) of the region where they differ most.

    Returns the region; None if there is nothing to show. Raises InputError if the data is gone.
    """
    rows = [row for row in scene.rows if row.runs]
    if not rows:
        return None
    views = read_views(Run(folder / rows[0].runs[0]).method(), Path(scene.path), "test", truth=False).views
    chosen = np.unique(np.linspace(0, len(views) - 1, CROP_VIEWS).round().astype(int))
    names = render_names(views)
    best: tuple[float, int, int, int, list[np.ndarray]] | None = None
    side = max(min(views[0].width, views[0].height) // CROP_SHARE, CROP_MIN)
    side = min(side, views[0].width, views[0].height)
    for index in chosen:
        truth = views[index].load().displayed
        pictures = _renders(folder, rows, names[index])
        if pictures is None or any(picture.shape != truth.shape for picture in pictures):
            continue
        score, y, x = most_different(truth, pictures, side)
        if best is None or score > best[0]:
            best = score, int(index), y, x, [truth, *pictures]
    if best is None:
        return None
    _, index, y, x, pictures = best
    cells = [
        (title, picture[y : y + side, x : x + side])
        for title, picture in zip(["ground truth", *(row.variant for row in rows)], pictures, strict=True)
    ]
    write_png(path, contact_sheet([dict(cells[i : i + ROW]) for i in range(0, len(cells), ROW)]))
    return Region(views[index].name, y, x, side)


def most_different(truth: np.ndarray, pictures: Sequence[np.ndarray], side: int) -> tuple[float, int, int]:
    """(score, row, column) of the square where the mean squared errors of pictures (H, W, 3) spread most.

    The score is the largest error minus the smallest; of a lone picture, its error.
    """
    errors = np.stack([box_mean(np.mean((picture - truth) ** 2, axis=-1), side) for picture in pictures])
    spread = errors.max(axis=0) - (errors.min(axis=0) if len(pictures) > 1 else 0)
    row, column = np.unravel_index(int(np.argmax(spread)), spread.shape)
    return float(spread[row, column]), int(row), int(column)


def box_mean(values: np.ndarray, side: int) -> np.ndarray:
    """Means (H − side + 1, W − side + 1) over all squares of values (H, W), by the upper left pixel."""
    sums = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    total = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return total / side**2


def _renders(folder: Path, rows: Sequence[Row], name: str) -> list[np.ndarray] | None:
    """Each row's picture of a view, (H, W, 3); None if one is missing."""
    try:
        return [read_png(folder / row.runs[0] / name)[..., :3] for row in rows]
    except InputError:
        return None
