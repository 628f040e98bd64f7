"""The page of a comparison: one static index.html, readable from disk, with plots and crops beside it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from html import escape

from mi_refgs.compare.plots import Region, write_crops, write_curves
from mi_refgs.compare.table import Row, Scene, Table
from mi_refgs.compare.text import cell, columns_of, header, heading, remarks
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.io.ownership import OutputFolder

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
