"""The files of a comparison: table.json, table.md, and a static page with plots and crops."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.compare.jobs import PAGE, PICTURES, TABLE, TABLE_TEXT, output_folder
from mi_refgs.compare.table import (
    Row,
    Scene,
    Table,
    cell,
    columns_of,
    header,
    heading,
    markdown,
    remarks,
    table_of,
)
from mi_refgs.compare.worker import CURVE, CURVE_KEYS
from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.evaluation.evaluate import render_names
from mi_refgs.evaluation.images import contact_sheet
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import read_png, write_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.runs.run import Run, read_log
from mi_refgs.runs.views import read_views

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
"""Key of a line of a curve, and the title of the axis."""
STYLES, DPI = ("-", "--", ":"), 140
"""Line styles, one per ten methods; pixels per inch, twice those of a common screen."""
CROP_VIEWS = 16
"""Test views, evenly spaced, that are searched for the crop."""
CROP_SHARE, CROP_MIN = 3, 24
"""The side of a crop is this fraction of the image's shorter side, at least so many pixels."""
ROW = 6
"""Crops per row."""


def write(folder: Path) -> Table:
    """Write the table of all jobs in a folder as table.json, table.md and a page.

    Raises InputError if there are none, or a file cannot be written.
    """
    table, output = table_of(folder), output_folder(folder)
    if not table.scenes:
        raise InputError("DATA: none given, and the folder has no comparison; name data sets to fit")
    output.require_free()
    content = json.dumps(asdict(table), indent=1, ensure_ascii=False)
    write_bytes(output.own(TABLE), f"{content}\n".encode())
    write_bytes(output.own(TABLE_TEXT), markdown(table).encode())
    write_page(output, table)
    return table


def write_page(output: OutputFolder, table: Table) -> None:
    """Write index.html and its images; raises InputError if a file cannot be written."""
    names: list[str] = []  # of scenes in addresses, each once
    for scene in table.scenes:
        name = re.sub(r"[^0-9A-Za-z]+", "_", scene.name).strip("_") or "scene"
        names.append(name if name not in names else f"{name}_{len(names)}")
    title = escape(f"Comparison: {', '.join(scene.name for scene in table.scenes)}")
    about, workers = table.about, int(table.about.get("workers", 1))
    timed = "with the machine to themselves" if workers == 1 else f"while {workers} jobs shared the machine"
    notes = "\n".join(f'<li id="note{n}">{escape(text)}</li>' for n, text in enumerate(table.footnotes, 1))
    machines = (", ".join(f"{key} {value}" for key, value in machine.items()) for machine in table.machines)
    settings = f", with {' '.join(about['set'])}" if about.get("set") else ""
    made_with = f"mi_refgs {about.get('version', '')}, preset {about.get('preset', '')}{settings}"
    content = f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{title}</h1>
<p>Means ± sample standard deviation over seeds; the best mean per column in bold. Frames and
training were timed {timed}.</p>
{"".join(_section(output, scene, name) for scene, name in zip(table.scenes, names, strict=True))}
{f"<h2>Deviations from the originals</h2>{chr(10)}<ol>{chr(10)}{notes}{chr(10)}</ol>" if notes else ""}
<h2>How it was made</h2>
<p>{escape(made_with)}</p>
<pre>{escape(str(about.get("command", "")))}</pre>
<ul>
{"".join(f"<li>{escape(machine)}</li>" for machine in machines)}</ul>
<p>The same numbers: <a href="table.json">table.json</a>, <a href="table.md">table.md</a>.</p>
</body>
</html>
"""
    write_bytes(output.own(PAGE), content.encode())


def _section(output: OutputFolder, scene: Scene, name: str) -> str:
    """Write the plot and the crops of a scene; returns its section of the page."""
    curves, crops = f"{PICTURES}/{name}_psnr.png", f"{PICTURES}/{name}_crops.png"
    figures, folder = "", output.path
    output.claim(curves, crops)
    if write_curves(folder, scene, folder / curves):
        figures += _figure(curves, f"PSNR on a few test views of {scene.name}, one line per seed")
    try:
        region = write_crops(folder, scene, folder / crops)
    except InputError as error:
        figures += f'<p class="remark">No crops: {escape(str(error))}.</p>\n'
    else:
        if region:
            figures += _figure(
                crops,
                f"{region.side}² pixels at row {region.row}, column {region.column} of view {region.view}, "
                "where the errors of the methods differ most (first seed of each)",
            )
    notes = "".join(f'<p class="remark">{escape(remark)}</p>\n' for remark in remarks(scene))
    return f"""<section id="{name}">
<h2>{escape(heading(scene))}</h2>
<div class="wide">
{_table(scene)}
</div>
{notes}{figures}</section>
"""


def _table(scene: Scene) -> str:
    """Return the table of a scene; the best mean of each column is marked where there are several."""
    columns = columns_of(scene)
    best: dict[str, float] = {}
    for column in columns:
        means = [number.mean for row in scene.rows if (number := row.numbers.get(column.key)) is not None]
        if column.higher is not None and len(means) > 1:
            best[column.key] = max(means) if column.higher else min(means)
    heads = "".join(f'<th scope="col">{escape(head)}</th>' for head in ["method", *map(header, columns)])
    lines = [f"<tr>{heads}</tr>"]
    for row in scene.rows:
        notes = ", ".join(f'<a href="#note{n}">{n}</a>' for n in row.footnotes)
        seeds = f' <span class="sd">({len(row.seeds)} seeds)</span>' if len(row.seeds) > 1 else ""
        cells = f"<td>{escape(row.variant)}{f'<sup>{notes}</sup>' if notes else ''}{seeds}</td>"
        for column in columns:
            number = row.numbers.get(column.key)
            mark = ' class="best"' if number and number.mean == best.get(column.key) else ""
            cells += f"<td{mark}>{escape(cell(column, number))}</td>"
        failed = ' class="failed"' if row.failed else ""
        lines.append(f"<tr{failed}>{cells}</tr>")
    return "<table>\n" + "\n".join(lines) + "\n</table>"


def _figure(source: str, caption: str) -> str:
    caption = escape(caption)
    return (
        f'<figure><img src="{escape(source)}" alt="{caption}"><figcaption>{caption}.</figcaption></figure>\n'
    )


# ---------- Curves ----------


def write_curves(folder: Path, scene: Scene, path: Path) -> bool:
    """Plot PSNR on test views over seconds and iterations: one colour per method, one line per seed.

    Returns False if no run has a curve; raises InputError if the file cannot be written.
    """
    lines = [(row, read_log(folder / run / CURVE, CURVE_KEYS)) for row in scene.rows for run in row.runs]
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


# ---------- Crops ----------


@dataclass(frozen=True)
class Region:
    """A square of a test view: its upper left pixel and its side."""

    view: str
    row: int
    column: int
    side: int


def write_crops(folder: Path, scene: Scene, path: Path) -> Region | None:
    """Write crops of ground truth and each method (first seed) where the methods differ most.

    Returns the region, or None without images; raises InputError if the data set is gone.
    """
    rows = [row for row in scene.rows if row.runs]
    if not rows:
        return None
    views = read_views(Run(folder / rows[0].runs[0]).method(), Path(scene.path), "test", truth=False).views
    chosen = evenly_spread(len(views), CROP_VIEWS)
    names = render_names(views)
    best: tuple[float, int, int, int, list[np.ndarray]] | None = None
    side = max(min(views[0].width, views[0].height) // CROP_SHARE, CROP_MIN)
    side = min(side, views[0].width, views[0].height)
    for index in chosen:
        reference = views[index].load().displayed
        images = _renders(folder, rows, names[index])
        if images is None or any(image.shape != reference.shape for image in images):
            continue
        score, y, x = most_different(reference, images, side)
        if best is None or score > best[0]:
            best = score, int(index), y, x, [reference, *images]
    if best is None:
        return None
    _, index, y, x, images = best
    cells = [
        (title, image[y : y + side, x : x + side])
        for title, image in zip(["ground truth", *(row.variant for row in rows)], images, strict=True)
    ]
    write_png(path, contact_sheet([dict(cells[i : i + ROW]) for i in range(0, len(cells), ROW)]))
    return Region(views[index].name, y, x, side)


def most_different(reference: np.ndarray, images: Sequence[np.ndarray], side: int) -> tuple[float, int, int]:
    """Return (score, row, column) of the square where mean squared errors of images (H, W, 3) differ most.

    The score is the largest error minus the smallest, or the error of a single image.
    """
    errors = np.stack([box_mean(np.mean((image - reference) ** 2, axis=-1), side) for image in images])
    spread = errors.max(axis=0) - (errors.min(axis=0) if len(images) > 1 else 0)
    row, column = np.unravel_index(int(np.argmax(spread)), spread.shape)
    return float(spread[row, column]), int(row), int(column)


def box_mean(values: np.ndarray, side: int) -> np.ndarray:
    """Return means (H − side + 1, W − side + 1) over all squares of `values` (H, W)."""
    sums = np.pad(values, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    total = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    return total / side**2


def _renders(folder: Path, rows: Sequence[Row], name: str) -> list[np.ndarray] | None:
    """Return the image (H, W, 3) of a view per row; None if one is missing."""
    try:
        return [read_png(folder / row.runs[0] / name)[..., :3] for row in rows]
    except InputError:
        return None
