"""The files of a comparison: table.json, table.md, and a static page with its tables."""

from __future__ import annotations

import json
from dataclasses import asdict
from html import escape
from pathlib import Path

from mi_refgs.compare import table as tables
from mi_refgs.compare.jobs import PAGE, TABLE, TABLE_TEXT
from mi_refgs.compare.table import Scene, Table
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 76rem; padding: 0 1rem; }
table { border-collapse: collapse; white-space: nowrap; display: block; overflow-x: auto; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #8886; text-align: right; }
th:first-child, td:first-child { text-align: left; }
"""


def write(folder: Path) -> Table:
    """Write the table of all jobs in a folder as table.json, table.md and a page."""
    table = tables.table_of(folder)
    if not table.scenes:
        what = "none given, and the folder has no comparison"
        raise InputError(what, "DATA", remedy="name data sets to fit")
    content = json.dumps(asdict(table), indent=1, ensure_ascii=False)
    write_bytes(folder / TABLE, f"{content}\n".encode())
    write_bytes(folder / TABLE_TEXT, tables.markdown(table).encode())
    write_bytes(folder / PAGE, _page(table).encode())
    return table


def _page(table: Table) -> str:
    title = escape(f"Comparison: {', '.join(scene.name for scene in table.scenes)}")
    about, workers = table.about, int(table.about.get("workers", 1))
    timed = "with the machine to themselves" if workers == 1 else f"while {workers} jobs shared the machine"
    machines = (", ".join(f"{key} {value}" for key, value in machine.items()) for machine in table.machines)
    made = " ".join(["mi_refgs", about.get("version", ""), "with preset", about.get("preset", "")])
    sections = "".join(map(_section, table.scenes))
    notes = "".join(f"<li>{escape(text)}</li>\n" for text in table.footnotes)
    return f"""<!DOCTYPE html>
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


def _section(scene: Scene) -> str:
    """Return the section of a scene; the best means are bold."""
    columns = tables.columns_of(scene)
    lines = ["".join(f"<th>{escape(head)}</th>" for head in ["method", *map(tables.header, columns)])]
    means = {c.key: [n.mean for row in scene.rows if (n := row.numbers.get(c.key))] for c in columns}
    for row in scene.rows:
        cells = [escape(tables.label(row))]
        for column in columns:
            found, best = row.numbers.get(column.key), max if column.higher else min
            text, several = escape(tables.cell(column, found)), len(means[column.key]) > 1
            bold = found and several and column.higher is not None and found.mean == best(means[column.key])
            cells.append(f"<b>{text}</b>" if bold else text)
        lines.append("".join(f"<td>{text}</td>" for text in cells))
    body = "".join(f"<tr>{line}</tr>\n" for line in lines)
    notes = "".join(f"<p>{escape(remark)}</p>\n" for remark in tables.remarks(scene))
    return f"<h2>{escape(tables.heading(scene))}</h2>\n<table>\n{body}</table>\n{notes}"
