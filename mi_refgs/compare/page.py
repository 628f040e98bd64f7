"""The page of a comparison: a static index.html that can be opened from disk, with plots and crops."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.compare.table import Row, Scene, Table, cell, columns_of, header, heading, remarks
from mi_refgs.compare.worker import CURVE
from mi_refgs.errors import InputError
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.evaluation.images import contact_sheet
from mi_refgs.fitting.targets import read_views
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import read_png, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.runs.run import Run

PAGE, PICTURES = "index.html", "pictures"
STYLE = """
:root { color-scheme: light dark; --line: #8886; --soft: #8882; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
h1, h2 { line-height: 1.2; } h2 { margin-top: 2.5rem; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; white-space: nowrap; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; }
tr.failed td { background: #c002; }
.best { font-weight: 700; } .sd, .remark { opacity: .75; }
img { max-width: 100%; background: #fff; border-radius: 4px; }
figure { margin: 1rem 0; } figcaption { font-size: .9em; opacity: .8; }
code, pre { background: var(--soft); border-radius: 3px; padding: .1em .3em; }
pre { padding: .6rem; overflow-x: auto; }
"""
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


def write_page(output: OutputFolder, table: Table) -> None:
    """Write index.html and its pictures; raises InputError if a file cannot be written."""
    names = _names(scene.name for scene in table.scenes)
    parts = [_scene(output, scene, name) for scene, name in zip(table.scenes, names, strict=True)]
    title = f"Comparison: {', '.join(scene.name for scene in table.scenes)}"
    content = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{escape(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{escape(title)}</h1>
<p>Means ± sample standard deviation over seeds; the best mean of each column in bold. Frames and training
were timed {_crowd(table)}.</p>
{"".join(parts)}
{_footnotes(table)}
{_made_with(table)}
</body>
</html>
"""
    write_bytes(output.own(PAGE), content.encode())


def _scene(output: OutputFolder, scene: Scene, name: str) -> str:
    curves, crops = f"{PICTURES}/{name}_psnr.png", f"{PICTURES}/{name}_crops.png"
    figures, folder = "", output.path
    output.claim(curves, crops)
    if write_curves(folder, scene, folder / curves):
        figures += _figure(
            curves,
            f"PSNR on a few test views of {scene.name} over training time and over iterations, a line a seed",
        )
    try:
        region = write_crops(folder, scene, folder / crops)
    except InputError as error:
        figures += f'<p class="remark">No crops: {escape(str(error))}.</p>\n'
    else:
        figures += _figure(crops, _crop_caption(region)) if region else ""
    said = "".join(f'<p class="remark">{escape(remark)}</p>\n' for remark in remarks(scene))
    return f"""<section id="{name}">
<h2>{escape(heading(scene))}</h2>
<div class="wide">
{_table(scene)}
</div>
{said}{figures}</section>
"""


def _crop_caption(region: Region) -> str:
    return (
        f"The square of {region.side}² pixels at row {region.row}, column {region.column} of test view "
        f"{region.view}, where the errors of the methods differ most (first seed of each)"
    )


def _table(scene: Scene) -> str:
    columns = columns_of(scene)
    heads = ["method", *map(header, columns)]
    lines = ["<tr>" + "".join(f'<th scope="col">{escape(head)}</th>' for head in heads) + "</tr>"]
    best = {c.key: _best(scene, c.key, c.higher) for c in columns if c.higher is not None}
    for row in scene.rows:
        cells = [f"<td>{_label(row)}</td>"]
        for column in columns:
            number = row.numbers.get(column.key)
            mark = ' class="best"' if number and number.mean == best.get(column.key) else ""
            cells.append(f"<td{mark}>{escape(cell(column, number))}</td>")
        mark = ' class="failed"' if row.failed else ""
        lines.append(f"<tr{mark}>{''.join(cells)}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _best(scene: Scene, key: str, higher: bool) -> float | None:
    means = [number.mean for row in scene.rows if (number := row.numbers.get(key)) is not None]
    if len(means) < 2:
        return None
    return max(means) if higher else min(means)


def _label(row: Row) -> str:
    """The row's name with links to its footnotes, and its seeds."""
    notes = ", ".join(f'<a href="#note{n}">{n}</a>' for n in row.footnotes)
    seeds = f' <span class="sd">({len(row.seeds)} seeds)</span>' if len(row.seeds) > 1 else ""
    return f"{escape(row.variant)}{f'<sup>{notes}</sup>' if notes else ''}{seeds}"


def _footnotes(table: Table) -> str:
    if not table.footnotes:
        return ""
    items = "\n".join(f'<li id="note{n}">{escape(text)}</li>' for n, text in enumerate(table.footnotes, 1))
    return f"<h2>Deviations from the originals</h2>\n<ol>\n{items}\n</ol>"


def _made_with(table: Table) -> str:
    """Machine, command line and versions."""
    about = table.about
    machines = "".join(
        "<li>" + escape(", ".join(f"{key} {value}" for key, value in machine.items())) + "</li>\n"
        for machine in table.machines
    )
    return f"""<h2>How it was made</h2>
<p>mi_refgs {escape(str(about.get("version", "")))}, preset {escape(str(about.get("preset", "")))}{
        escape(", with " + " ".join(about["set"])) if about.get("set") else ""
    }</p>
<pre>{escape(str(about.get("command", "")))}</pre>
<ul>
{machines}</ul>
<p>The same numbers: <a href="table.json">table.json</a>, <a href="table.md">table.md</a>.</p>"""


def _crowd(table: Table) -> str:
    workers = int(table.about.get("workers", 1))
    return "with the machine to themselves" if workers == 1 else f"while {workers} jobs shared the machine"


def _figure(source: str, caption: str) -> str:
    return (
        f'<figure><img src="{escape(source)}" alt="{escape(caption)}"><figcaption>{escape(caption)}.'
        "</figcaption></figure>\n"
    )


def _names(scenes: Iterable[str]) -> list[str]:
    """File names of scenes, each once: letters that may not stand in an address are replaced."""
    names: list[str] = []
    for scene in scenes:
        name = re.sub(r"[^0-9A-Za-z]+", "_", scene).strip("_") or "scene"
        names.append(name if name not in names else f"{name}_{len(names)}")
    return names


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
