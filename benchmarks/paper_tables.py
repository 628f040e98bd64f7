"""The tables that the paper prints, with figures of a comparison below its own.

    refgs compare data/ball data/car --methods ref_gaussian -o runs/paper
    python -m benchmarks.paper_tables 1 -o runs/paper

The figures of paper_tables.json are the paper's: nothing here measured them. A data set counts as a scene of
the paper by the name of its folder."""

import re
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

from benchmarks.common.report import plain_parser
from mi_refgs.compare.table import NOTHING, Row, Scene, Table, aligned, table_of
from mi_refgs.errors import InputError
from mi_refgs.io.files import read_json

PAPER = read_json(Path(__file__).with_suffix(".json"))
DATA_SETS: dict[str, dict[str, Any]] = PAPER["data_sets"]  # name → of, folder, words, scenes → folder names
TABLES: dict[int, dict[str, Any]] = {table["table"]: table for table in PAPER["tables"]}
"""Number → caption, columns, and metrics → systems → a figure for each column."""
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
Place = tuple[str, str]
"""Data set and scene. Without a scene, the average over a data set; without both, over UNNAMED."""


class Line(NamedTuple):
    """A row: a system's published figures, ours, or their difference; None where there is none."""

    title: str
    values: tuple[float | None, ...]
    sign: str = ""


class Comparison(NamedTuple):
    """A table of the paper with ours."""

    lines: dict[str, list[Line]]  # by metric
    missing: dict[str, list[str]]  # data set → scenes that no finished run is of
    partial: bool  # some average of ours is over a part of its scenes


def places(column: Place) -> list[Place]:
    """Return the scenes that a column is about."""
    data_set, scene = column
    if scene:
        return [column]
    return [(name, s) for name in ([data_set] if data_set else UNNAMED) for s in DATA_SETS[name]["scenes"]]


def place_of(folder: Path) -> Place | None:
    """Return the scene of the paper after which a folder is named; None for none, and where it could be two.

    The folder's name is the scene's, with nothing but numbers and the data set's words beside it: `ball`,
    `chair_400`, `teapot_glossy`. Where two data sets have a scene of that name, a word of one of them must
    be in the folder's name or in its parent's."""
    tokens = {token for token in re.split(r"[^a-z0-9]+", folder.name.lower()) if token}
    found = []
    for name, about in DATA_SETS.items():
        permitted = OTHER_WORDS.union(about["words"])
        for scene, aliases in about["scenes"].items():
            rest = tokens - set(aliases)
            if rest != tokens and all(token.isdecimal() or token in permitted for token in rest):
                found.append((name, scene))
    if len(found) > 1:
        above = f"{folder.parent.name} {folder.name}".lower()
        found = [place for place in found if any(word in above for word in DATA_SETS[place[0]]["words"])]
    return found[0] if len(found) == 1 else None


def compared(number: int, ours: Table | None) -> Comparison:
    """Compare table `number` with the finished runs of `ours`; raises InputError for an unknown number."""
    if number not in TABLES:
        known = ", ".join(map(str, TABLES))
        raise InputError(f"table {number}: not in the paper; give one of {known}")
    columns = [places(tuple(column)) for column in TABLES[number]["columns"]]
    scenes: dict[Place, Scene] = {
        found: scene
        for scene in (ours.scenes if ours else [])
        if (found := place_of(Path(scene.path))) and any(row.seeds for row in scene.rows)
    }
    missing: dict[str, list[str]] = {}
    for place in dict.fromkeys(place for column in columns for place in column):
        missing.setdefault(place[0], []).extend([place[1]] if place not in scenes else [])
    # Below each published line, ours of every variant that names its row, and the difference.
    variants = dict.fromkeys((r.variant, r.paper_row) for s in scenes.values() for r in s.rows if r.paper_row)
    lines: dict[str, list[Line]] = {}
    partial = False
    for metric, systems in TABLES[number]["metrics"].items():
        of_metric = lines[metric] = []
        for system, values in systems.items():
            of_metric.append(Line(f"{system} (published)", tuple(values)))
            for variant in (name for name, row in variants if row == system):
                mine = [_ours(metric, variant, column, scenes) for column in columns]
                if all(value is None for value, _ in mine):
                    continue
                of_metric.append(Line(f"  ours: {variant}", tuple(value for value, _ in mine)))
                partial |= any(value is not None and not whole for value, whole in mine)
                differences = [
                    value - theirs if value is not None and whole else None
                    for (value, whole), theirs in zip(mine, values, strict=True)
                ]
                of_metric.append(Line("  ours − paper", tuple(differences), "+"))
    return Comparison(lines, missing, partial)


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


def text(number: int, ours: Table | None) -> str:
    """Return the comparison as Markdown; raises InputError as `compared` does."""
    found, table = compared(number, ours), TABLES[number]
    lines = [f"### Table {number}: {table['caption']}", "", f"Published figures: {PAPER['source']}."]
    heads = [_head(column, table["columns"]) for column in table["columns"]]
    for metric, rows in found.lines.items():
        title, form = TITLES[metric]
        body = [
            [row.title, *(NOTHING if x is None else format(x, row.sign + form) for x in row.values)]
            for row in rows
        ]
        lines += ["", *aligned([title, *heads], body)]
    if found.partial:
        lines += ["", "Averages of ours over a part of the scenes have no difference."]
    if not any(row.title.startswith("  ") for rows in found.lines.values() for row in rows):
        lines += ["", "No finished run is of a scene of this table."]
    for name, scenes in found.missing.items():
        if scenes:
            about = DATA_SETS[name]
            folders = ", ".join(f"{about['folder']}/{about['scenes'][scene][0]}" for scene in scenes)
            absent = f"Missing: {name} ({about['of']}): {', '.join(scenes)}."
            lines += ["", f"{absent} Its folders: {folders}; name them as DATA."]
    return "\n".join(lines)


def _head(column: Place, columns: list[Place]) -> str:
    """Return the title of a column: with its data set where two have scenes of one name."""
    data_set, scene = column
    if not scene:
        return f"mean, {data_set}" if data_set else "mean"
    return f"{scene} ({data_set.split()[0]})" if sum(s == scene for _, s in columns) > 1 else scene


if __name__ == "__main__":
    parser = plain_parser("paper_tables", __doc__)
    parser.add_argument("table", type=int, metavar="N", help="number of the table in the paper")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="folder of `refgs compare`")
    args = parser.parse_args()
    print(text(args.table, None if args.output is None else table_of(args.output)))
