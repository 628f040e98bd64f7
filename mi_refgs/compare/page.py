"""The files of a comparison: table.json, table.md, and a static page with tables and plots."""

from __future__ import annotations

import json
from dataclasses import asdict
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

from mi_refgs.compare.jobs import PAGE, PICTURES, TABLE, TABLE_TEXT
from mi_refgs.compare.table import (
    Scene,
    Table,
    cell,
    columns_of,
    header,
    heading,
    label,
    markdown,
    remarks,
    table_of,
)
from mi_refgs.compare.worker import CURVE, CURVE_KEYS
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.runs.run import read_log

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
table { border-collapse: collapse; white-space: nowrap; display: block; overflow-x: auto; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #8886; text-align: right; }
th:first-child, td:first-child { text-align: left; }
img { max-width: 100%; background: #fff; }
"""
AXES = (("seconds", "training (s)"), ("iteration", "iterations"))
"""Key of a line of a curve, and the title of the axis."""
STYLES, DPI = ("-", "--", ":"), 140
"""Line styles, one per ten methods; pixels per inch, twice those of a common screen."""


def write(folder: Path) -> Table:
    """Write the table of all jobs in a folder as table.json, table.md and a page.

    Raises InputError if there are none, or a file cannot be written.
    """
    table = table_of(folder)
    if not table.scenes:
        raise InputError(
            "none given, and the folder has no comparison", "DATA", remedy="name data sets to fit"
        )
    content = json.dumps(asdict(table), indent=1, ensure_ascii=False)
    write_bytes(folder / TABLE, f"{content}\n".encode())
    write_bytes(folder / TABLE_TEXT, markdown(table).encode())
    write_page(folder, table)
    return table


def write_page(folder: Path, table: Table) -> None:
    """Write index.html and its plots; raises InputError if a file cannot be written."""
    title = escape(f"Comparison: {', '.join(scene.name for scene in table.scenes)}")
    about, workers = table.about, int(table.about.get("workers", 1))
    timed = "with the machine to themselves" if workers == 1 else f"while {workers} jobs shared the machine"
    machines = (", ".join(f"{key} {value}" for key, value in machine.items()) for machine in table.machines)
    made = " ".join(["mi_refgs", about.get("version", ""), "with preset", about.get("preset", "")])
    sections = "".join(_section(folder, scene, i) for i, scene in enumerate(table.scenes))
    notes = "".join(f"<li>{escape(text)}</li>\n" for text in table.footnotes)
    content = f"""<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>{title}</title>
<style>{STYLE}</style>
<h1>{title}</h1>
<p>Means ± sample standard deviation over seeds; the best mean per column in bold. Frames and
training were timed {timed}.</p>
{sections}
{f"<h2>Deviations from the originals</h2><ol>{notes}</ol>" if notes else ""}
<h2>How it was made</h2>
<p>{escape(made)}: {escape("; ".join(machines))}</p>
<pre>{escape(str(about.get("command", "")))}</pre>
<p>The same numbers: <a href="table.json">table.json</a>, <a href="table.md">table.md</a>.</p>
</html>
"""
    write_bytes(folder / PAGE, content.encode())


def _section(folder: Path, scene: Scene, number: int) -> str:
    """Write the plot of a scene; returns its section of the page, whose best means are bold."""
    columns = columns_of(scene)
    lines = ["".join(f"<th>{escape(head)}</th>" for head in ["method", *map(header, columns)])]
    means = {c.key: [n.mean for row in scene.rows if (n := row.numbers.get(c.key))] for c in columns}
    for row in scene.rows:
        cells = [escape(label(row))]
        for column in columns:
            found, best = row.numbers.get(column.key), max if column.higher else min
            text, several = escape(cell(column, found)), len(means[column.key]) > 1
            bold = found and several and column.higher is not None and found.mean == best(means[column.key])
            cells.append(f"<b>{text}</b>" if bold else text)
        lines.append("".join(f"<td>{text}</td>" for text in cells))
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    notes = "".join(f"<p>{escape(remark)}</p>\n" for remark in remarks(scene))
    curves = f"{PICTURES}/{number}_psnr.png"
    plot = ""
    if write_curves(folder, scene, folder / curves):
        said = "PSNR on a few test views, one line per seed"
        plot = f'<p>{said}:</p>\n<img src="{curves}" alt="{said}">\n'
    return f"<h2>{escape(heading(scene))}</h2>\n<table>\n{body}</table>\n{notes}{plot}"


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
