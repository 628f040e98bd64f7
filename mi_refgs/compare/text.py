"""The table as text: Markdown, which is also what the terminal shows."""

from __future__ import annotations

from collections.abc import Sequence

from mi_refgs.compare.table import COLUMNS, Column, Row, Scene, Statistic, Table

NOTHING = "–"


def markdown(table: Table) -> str:
    """One table a scene, the deviations of its methods as numbered footnotes, and what failed."""
    lines: list[str] = []
    for scene in table.scenes:
        lines += [f"### {heading(scene)}", "", *_table(scene), ""]
        lines += [f"{remark}\n" for remark in remarks(scene)]
    if table.footnotes:
        lines += ["Deviations from the originals:", ""]
        lines += [f"{number}. {text}" for number, text in enumerate(table.footnotes, 1)]
    return "\n".join(lines).rstrip() + "\n"


def heading(scene: Scene) -> str:
    """The scene's name with the pictures that its numbers are means over."""
    if not scene.image_size:
        return scene.name
    width, height = scene.image_size
    scale = f", downscaled by {scene.downscale}" if scene.downscale not in (None, 1) else ""
    return f"{scene.name} ({scene.test_views} test views of {width} × {height} pixels{scale})"


def remarks(scene: Scene) -> list[str]:
    """What a reader of a scene's numbers has to be told: failures, numbers that are missing, the paper."""
    said = []
    for row in scene.rows:
        said += [f"{row.variant}, seed {seed}: failed: {why}." for seed, why in row.failed.items()]
        said += [f"{row.variant}, seed {seed}: not finished." for seed in row.unfinished]
    for column in COLUMNS:
        reasons = [row.missing[column.key] for row in scene.rows if column.key in row.missing]
        if reasons and column not in columns_of(scene):
            said.append(f"{column.title}: none: {reasons[0]}.")
    return said


def columns_of(scene: Scene) -> list[Column]:
    """The columns that at least one row has a number in."""
    return [column for column in COLUMNS if any(row.numbers.get(column.key) for row in scene.rows)]


def header(column: Column) -> str:
    """A column's title with its unit."""
    return f"{column.title} ({column.unit})" if column.unit else column.title


def cell(column: Column, number: Statistic | None) -> str:
    """Mean ± s.d."""
    if number is None:
        return NOTHING
    mean = column.text(number.mean)
    return mean if number.sd is None else f"{mean} ± {column.text(number.sd)}"


def label(row: Row) -> str:
    """The row's name with the numbers of its footnotes."""
    marks = f" [{','.join(map(str, row.footnotes))}]" if row.footnotes else ""
    seeds = f" ({len(row.seeds)} seeds)" if len(row.seeds) > 1 else ""
    return f"{row.variant}{marks}{seeds}"


def _table(scene: Scene) -> list[str]:
    columns = columns_of(scene)
    body = [
        [label(row), *(cell(column, row.numbers.get(column.key)) for column in columns)] for row in scene.rows
    ]
    return aligned(["method", *map(header, columns)], body)


def aligned(titles: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a Markdown table whose columns stand below each other: the first left, the others right."""
    widths = [max(len(line[i]) for line in [titles, *body]) for i in range(len(titles))]
    rule = [f":{'-' * (w - 1)}" if i == 0 else f"{'-' * (w - 1)}:" for i, w in enumerate(widths)]

    def line(cells: Sequence[str]) -> str:
        first, *others = zip(cells, widths, strict=True)
        padded = [first[0].ljust(first[1]), *(text.rjust(width) for text, width in others)]
        return f"| {' | '.join(padded)} |"

    return [line(titles), line(rule), *map(line, body)]
