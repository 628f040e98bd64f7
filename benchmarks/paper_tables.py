"""The tables that the paper prints, with figures of a comparison below its own.

    refgs compare data/ball data/car --methods ref_gaussian -o runs/paper
    python -m benchmarks.paper_tables 1 -o runs/paper

The figures of paper_tables.json are the paper's: nothing here measured them. A data set counts as a scene of
the paper by the name of its folder."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from benchmarks.common.report import plain_parser
from mi_refgs.compare.table import NOTHING, Row, Scene, Table, aligned, table_of
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json

OTHER_WORDS = {"blender", "synthetic", "ref", "scene", "data", "dataset"}
"""Words that may be part of a folder's name beside the scene, its data set and numbers."""
UNNAMED = ("Shiny Blender", "Glossy Synthetic")  # data sets of averages for which the paper names none
TITLES = {
    "psnr": ("PSNR (dB)", ".2f"),
    "ssim": ("SSIM", ".3f"),
    "lpips": ("LPIPS", ".3f"),
    "normal_mae_deg_full": ("normal error, whole image (°)", ".2f"),
    "normal_ssim": ("normals, SSIM", ".3f"),
    "normal_lpips": ("normals, LPIPS", ".4f"),
    "env_lpips": ("light, LPIPS", ".4f"),
    "train_hours": ("training (h)", ".2f"),
    "fps": ("frames per second", "g"),
}
"""Metric → title and format."""


class Place(NamedTuple):
    """A scene of the paper. Without a scene, the average over a data set; without both, over UNNAMED."""

    data_set: str
    scene: str


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper: metrics → systems → a figure for each column."""

    number: int
    caption: str
    columns: tuple[Place, ...]
    metrics: dict[str, dict[str, list[float]]]


@dataclass(frozen=True)
class Figures:
    """All tables, and the data sets that they are about."""

    source: str
    data_sets: dict[str, dict[str, Any]]  # name → of, folder, words, scenes → folder names
    tables: dict[int, PaperTable]

    @staticmethod
    def read() -> Figures:
        """Read paper_tables.json."""
        content = read_json(Path(__file__).with_suffix(".json"))
        tables = {}
        for number, caption, columns, metrics in map(dict.values, content["tables"]):
            tables[number] = PaperTable(number, caption, tuple(Place(*x) for x in columns), metrics)
        return Figures(content["source"], content["data_sets"], tables)

    def places(self, column: Place) -> list[Place]:
        """Return the scenes that a column is about."""
        if column.scene:
            return [column]
        names = [column.data_set] if column.data_set else UNNAMED
        return [Place(name, scene) for name in names for scene in self.data_sets[name]["scenes"]]


def place_of(folder: Path, figures: Figures) -> Place | None:
    """Return the scene of the paper after which a folder is named; None for none, and where it could be two.

    The folder's name is the scene's, with nothing but numbers and the data set's words beside it: `ball`,
    `chair_400`, `teapot_glossy`. Where two data sets have a scene of that name, a word of one of them must
    be in the folder's name or in its parent's."""
    tokens = {token for token in re.split(r"[^a-z0-9]+", folder.name.lower()) if token}
    found = []
    for name, about in figures.data_sets.items():
        permitted = OTHER_WORDS.union(about["words"])
        for scene, aliases in about["scenes"].items():
            rest = tokens - set(aliases)
            if rest != tokens and all(token.isdecimal() or token in permitted for token in rest):
                found.append(Place(name, scene))
    if len(found) > 1:
        above = f"{folder.parent.name} {folder.name}".lower()
        found = [p for p in found if any(word in above for word in figures.data_sets[p.data_set]["words"])]
    return found[0] if len(found) == 1 else None


class Line(NamedTuple):
    """A row: a system's published figures, ours, or their difference; None where there is none."""

    title: str
    values: tuple[float | None, ...]
    sign: str = ""


@dataclass
class Comparison:
    """A table of the paper, its lines by metric, and the scenes that no finished run is of."""

    table: PaperTable
    lines: dict[str, list[Line]] = field(default_factory=dict)
    missing: dict[str, list[str]] = field(default_factory=dict)  # data set → scenes
    partial: bool = False  # some average of ours is over a part of its scenes


def compared(number: int, ours: Table | None, figures: Figures) -> Comparison:
    """Compare table `number` with the finished runs of `ours`; raises InputError for an unknown number."""
    if number not in figures.tables:
        known = ", ".join(map(str, figures.tables))
        raise InputError(f"table {number}: not in the paper; give one of {known}")
    table = figures.tables[number]
    result = Comparison(table)
    scenes: dict[Place, Scene] = {
        found: scene
        for scene in (ours.scenes if ours else [])
        if (found := place_of(Path(scene.path), figures)) and any(row.seeds for row in scene.rows)
    }
    # Scenes without a finished run.
    for place in (place for column in table.columns for place in figures.places(column)):
        named = result.missing.setdefault(place.data_set, [])
        if place not in scenes and place.scene not in named:
            named.append(place.scene)
    # Below each published line, ours of every variant that names its row, and the difference.
    variants = dict.fromkeys((r.variant, r.paper_row) for s in scenes.values() for r in s.rows if r.paper_row)
    for metric, systems in table.metrics.items():
        lines = result.lines.setdefault(metric, [])
        for system, values in systems.items():
            lines.append(Line(f"{system} (published)", tuple(values)))
            for variant in (name for name, row in variants if row == system):
                mine = [_ours(metric, variant, figures.places(c), scenes) for c in table.columns]
                if all(value is None for value, _ in mine):
                    continue
                lines.append(Line(f"  ours: {variant}", tuple(value for value, _ in mine)))
                result.partial |= any(value is not None and not whole for value, whole in mine)
                differences = [
                    value - theirs if value is not None and whole else None
                    for (value, whole), theirs in zip(mine, values, strict=True)
                ]
                lines.append(Line("  ours − paper", tuple(differences), "+"))
    return result


def _ours(
    metric: str, variant: str, places: list[Place], scenes: dict[Place, Scene]
) -> tuple[float | None, bool]:
    """Return our mean over the scenes that have it, and whether all have."""
    rows = [row for p in places if p in scenes for row in scenes[p].rows if row.variant == variant]
    values = [value for row in rows if (value := _figure(metric, row)) is not None]
    return (fmean(values) if values else None), len(values) == len(places)


def _figure(metric: str, row: Row) -> float | None:
    """Return the mean of a row in the paper's unit."""
    key = {"train_hours": "train_seconds", "fps": "ms_per_frame"}.get(metric, metric)
    if (number := row.numbers.get(key)) is None:
        return None
    return {"train_hours": number.mean / 3600, "fps": 1000 / number.mean}.get(metric, number.mean)


def text(found: Comparison, figures: Figures) -> str:
    """Return the comparison as Markdown."""
    table = found.table
    lines = [f"### Table {table.number}: {table.caption}", "", f"Published figures: {figures.source}."]
    heads = [_head(column, table.columns) for column in table.columns]
    for metric, rows in found.lines.items():
        title, form = TITLES[metric]

        def cell(value: float | None, sign: str, form: str = form) -> str:
            return NOTHING if value is None else format(value, sign + form)

        body = [[row.title, *(cell(value, row.sign) for value in row.values)] for row in rows]
        lines += ["", *aligned([title, *heads], body)]
    if found.partial:
        lines += ["", "Averages of ours over a part of the scenes have no difference."]
    if not any(row.title.startswith("  ") for rows in found.lines.values() for row in rows):
        lines += ["", "No finished run is of a scene of this table."]
    for name, scenes in found.missing.items():
        if scenes:
            about = figures.data_sets[name]
            folders = ", ".join(f"{about['folder']}/{about['scenes'][scene][0]}" for scene in scenes)
            absent = f"Missing: {name} ({about['of']}): {', '.join(scenes)}."
            lines += ["", f"{absent} Its folders: {folders}; name them as DATA."]
    return "\n".join(lines)


def _head(column: Place, columns: tuple[Place, ...]) -> str:
    """Return the title of a column: with its data set where two have scenes of one name."""
    if not column.scene:
        return f"mean, {column.data_set}" if column.data_set else "mean"
    twice = sum(other.scene == column.scene for other in columns) > 1
    return f"{column.scene} ({column.data_set.split()[0]})" if twice else column.scene


def main() -> None:
    """Print a table."""
    parser = plain_parser("paper_tables", __doc__)
    parser.add_argument("table", type=int, metavar="N", help="number of the table in the paper")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="folder of `refgs compare`")
    args = parser.parse_args()
    figures = Figures.read()
    ours = None if args.output is None else table_of(args.output)
    print(text(compared(args.table, ours, figures), figures))


if __name__ == "__main__":
    main()
