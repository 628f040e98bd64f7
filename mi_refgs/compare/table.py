"""The table of a comparison: mean ± standard deviation over seeds per scene and method."""

import json
import statistics
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from mi_refgs.compare.jobs import FAILED, Job, finished, jobs_in, require_one_size, settings_of
from mi_refgs.errors import InputError
from mi_refgs.evaluation.scores import SCORES, Score, caption
from mi_refgs.io.files import read_json, write_bytes

TABLE, TABLE_TEXT = "table.json", "table.md"  # in the folder of the comparison
NOTHING = "–"
COLUMNS = tuple(score for score in SCORES if score.compared)


@dataclass(frozen=True)
class Statistic:
    """A number over seeds; `sd` is the sample standard deviation, None for one seed."""

    mean: float
    sd: float | None
    values: tuple[float, ...]

    @staticmethod
    def of(values: Sequence[float]) -> "Statistic":
        """Return the statistic of at least one value."""
        sd = statistics.stdev(values) if len(values) > 1 else None
        return Statistic(statistics.fmean(values), sd, tuple(map(float, values)))


@dataclass
class Row:
    """Results of a method on a scene."""

    variant: str
    name: str  # title of the method
    seeds: list[int] = field(default_factory=list)  # of finished runs
    runs: list[str] = field(default_factory=list)  # their folders, below the comparison's
    numbers: dict[str, Statistic | None] = field(default_factory=dict)  # by a column's key
    missing: dict[str, str] = field(default_factory=dict)  # why a number is None
    failed: dict[int, str] = field(default_factory=dict)  # seed → why
    unfinished: list[int] = field(default_factory=list)
    footnotes: list[int] = field(default_factory=list)  # deviations from the original, numbered from 1
    paper_row: str = ""  # the paper's name for the method


@dataclass
class Scene:
    name: str
    path: str
    rows: list[Row] = field(default_factory=list)
    image_size: list[int] = field(default_factory=list)
    downscale: float | None = None  # of the files' pixels; None: not recorded
    test_views: int = 0


@dataclass
class Table:
    """All scenes of a comparison, and how they were made."""

    scenes: list[Scene] = field(default_factory=list)
    footnotes: list[str] = field(default_factory=list)
    machines: list[dict[str, Any]] = field(default_factory=list)
    about: dict[str, Any] = field(default_factory=dict)  # preset, settings, command line, versions

    @property
    def complete(self) -> bool:
        return not any(row.failed or row.unfinished for scene in self.scenes for row in scene.rows)


def write(folder: Path) -> Table:
    """Write the table of all jobs in a folder as table.json and table.md; InputError without a job."""
    table = table_of(folder)
    if not table.scenes:
        what = "none given, and the folder has no comparison"
        raise InputError(what, "DATA", remedy="name data sets to fit")
    write_bytes(folder / TABLE, f"{json.dumps(asdict(table), indent=1, ensure_ascii=False)}\n".encode())
    write_bytes(folder / TABLE_TEXT, markdown(table).encode())
    return table


def table_of(folder: Path) -> Table:
    """Tabulate all jobs of a comparison, unreadable ones as failed; InputError for different image sizes."""
    about = settings_of(folder)

    def order(job: Job) -> tuple[Any, ...]:
        """Data sets and methods in the order in which they were given; others last."""
        key: list[Any] = []
        for name, value in (("data", job.data), ("variants", job.name)):
            given = about.get(name, [])
            key += [given.index(value) if value in given else len(given), value]
        return *key, job.seed

    table = Table(about=about)
    for data, jobs_of_scene in groupby(sorted(jobs_in(folder), key=order), lambda job: job.data):
        scene, sizes = Scene(Path(data).name, data), dict[str, list[int]]()
        for name, jobs_of_row in groupby(jobs_of_scene, lambda job: job.name):
            row, metrics = Row(name, name), list[dict[str, Any]]()
            for job in jobs_of_row:
                try:
                    if job.run.exists():
                        method = job.run.method().about
                        row.name, row.paper_row = method.name or row.variant, method.paper_row
                        table.footnotes += [x for x in method.deviations if x not in table.footnotes]
                        row.footnotes = [table.footnotes.index(text) + 1 for text in method.deviations]
                    found = finished(job)
                except InputError as error:  # a config.toml of another version
                    row.failed[job.seed] = str(error)
                    continue
                if found is None:
                    if (failure := job.run.path / FAILED).is_file():
                        row.failed[job.seed] = str(read_json(failure).get("reason"))
                    else:
                        row.unfinished.append(job.seed)
                    continue
                metrics.append(found)
                row.seeds.append(job.seed)
                row.runs.append(str(job.run.path.relative_to(folder.resolve())))
                sizes[row.runs[-1]] = scene.image_size = found["image_size"]
                scene.test_views, scene.downscale = found["test_views"], found.get("downscale")
                if found["machine"] not in table.machines:
                    table.machines.append(found["machine"])
            _fill(row, metrics)
            scene.rows.append(row)
        require_one_size(str(folder), sizes, "remove the runs of one size, and fit them again in the other")
        table.scenes.append(scene)
    return table


def _fill(row: Row, found: list[dict[str, Any]]) -> None:
    for column in COLUMNS:
        values = [m[column.key] for m in found]
        row.numbers[column.key] = Statistic.of(values) if values and None not in values else None
        reasons = [m.get(f"{column.reason}_reason") for m in found if m[column.key] is None]
        if reasons and reasons[0]:
            row.missing[column.key] = str(reasons[0])


def markdown(table: Table) -> str:
    """Return one table per scene, failures, deviations of methods as footnotes, and how it was made."""
    lines: list[str] = []
    for scene in table.scenes:
        columns = columns_of(scene)
        titles = ["method", *(f"{c.title} ({c.unit.strip()})" if c.unit else c.title for c in columns)]
        body = []
        for row in scene.rows:
            marks = f" [{','.join(map(str, row.footnotes))}]" if row.footnotes else ""
            seeds = f" ({len(row.seeds)} seeds)" if len(row.seeds) > 1 else ""
            body.append([f"{row.variant}{marks}{seeds}", *(cell(c, row.numbers.get(c.key)) for c in columns)])
        scale = f", downscaled for the fits by {by:g}" if (by := scene.downscale or 1) > 1 else ""
        size = " × ".join(map(str, scene.image_size))
        images = f" ({scene.test_views} test views of {size} pixels{scale})" if size else ""
        lines += [f"### {scene.name}{images}", "", *aligned(titles, body), ""]
        lines += [f"{remark}\n" for remark in remarks(scene)]
    if table.footnotes:
        lines += ["Deviations from the originals:", ""]
        lines += [*(f"{number}. {text}" for number, text in enumerate(table.footnotes, 1)), ""]
    if about := table.about:
        machines = (", ".join(f"{key} {value}" for key, value in one.items()) for one in table.machines)
        made = f"mi_refgs {about['version']}, preset {about['preset']}, {about['workers']} jobs at once"
        lines += [f"Made by {'; '.join([made, *machines])}:", "", f"    {about['command']}"]
    return "\n".join(lines).rstrip() + "\n"


def remarks(scene: Scene) -> list[str]:
    """Return the caption, failures, and reasons of missing numbers, of a scene."""
    about = caption(scene.image_size) if scene.image_size else {}
    said = ["; ".join(f"{key}: {text}" for key, text in about.items()) + "."] if about else []
    for row in scene.rows:
        said += [f"{row.variant}, seed {seed}: failed: {why}." for seed, why in row.failed.items()]
        said += [f"{row.variant}, seed {seed}: not finished." for seed in row.unfinished]
    for column in COLUMNS:
        reasons = [row.missing[column.key] for row in scene.rows if column.key in row.missing]
        if reasons and column not in columns_of(scene):
            said.append(f"{column.title}: none: {'; '.join(dict.fromkeys(reasons))}.")
    return said


def columns_of(scene: Scene) -> list[Score]:
    """Return the columns in which at least one row has a number."""
    return [column for column in COLUMNS if any(row.numbers.get(column.key) for row in scene.rows)]


def cell(column: Score, number: Statistic | None) -> str:
    """Format a mean ± standard deviation."""
    if number is None:
        return NOTHING
    return " ± ".join(column.form.format(x) for x in (number.mean, number.sd) if x is not None)


def aligned(titles: Sequence[str], body: Sequence[Sequence[str]]) -> list[str]:
    """Return lines of a Markdown table: the first column left-aligned, the others right-aligned."""
    widths = [max(len(line[i]) for line in [titles, *body]) for i in range(len(titles))]
    rule = [f":{'-' * (w - 1)}" if i == 0 else f"{'-' * (w - 1)}:" for i, w in enumerate(widths)]

    def line(cells: Sequence[str]) -> str:
        padded = [text.rjust(width) for text, width in zip(cells, widths, strict=True)]
        return f"| {' | '.join([cells[0].ljust(widths[0]), *padded[1:]])} |"

    return [line(titles), line(rule), *map(line, body)]
