"""A table of the paper with our figures below its own, and the data that is missing for the others."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from statistics import fmean

from mi_refgs.compare.paper import Figures, PaperTable, Place
from mi_refgs.compare.table import Row, Scene, Table
from mi_refgs.compare.text import NOTHING, aligned
from mi_refgs.errors import InputError

UNNAMED = ("Shiny Blender", "Glossy Synthetic")
"""Over these ours are averaged where the paper names no data set: its synthetic glossy ones."""
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
"""Metric of paper.json → title and form. What this package does not measure has no figure of ours."""


@dataclass(frozen=True)
class Line:
    """A row: a system's published figures, ours, or their difference; None where there is none."""

    title: str
    values: tuple[float | None, ...]
    signed: bool = False


@dataclass
class Comparison:
    """A table of the paper, its lines by metric, and the scenes that no finished run is of."""

    table: PaperTable
    lines: dict[str, list[Line]] = field(default_factory=dict)
    missing: dict[str, list[str]] = field(default_factory=dict)  # data set → scenes
    partial: bool = False  # some average of ours is over a part of its scenes


def compared(number: int, ours: Table | None, figures: Figures) -> Comparison:
    """Table `number` of the paper beside the finished runs of `ours`; raises InputError if there is none."""
    if number not in figures.tables:
        known = ", ".join(map(str, figures.tables))
        raise InputError(f"--paper-table: {number}: no such table in the paper; give one of {known}")
    table = figures.tables[number]
    result = Comparison(table)
    scenes = {
        (scene.place.data_set, scene.place.scene): scene
        for scene in (ours.scenes if ours else [])
        if scene.place is not None and any(row.seeds for row in scene.rows)
    }
    for column in table.columns:
        for place in _places(column, figures):
            named = result.missing.setdefault(place[0], [])
            if place not in scenes and place[1] not in named:
                named.append(place[1])
    variants = dict.fromkeys((r.variant, r.paper_row) for s in scenes.values() for r in s.rows if r.paper_row)
    for metric, systems in table.metrics.items():
        lines = result.lines.setdefault(metric, [])
        for system, values in systems.items():
            lines.append(Line(f"{system} (published)", tuple(values)))
            for variant in (name for name, row in variants if row == system):
                mine = [_ours(metric, variant, _places(c, figures), scenes) for c in table.columns]
                if all(value is None for value, _ in mine):
                    continue
                lines.append(Line(f"  ours: {variant}", tuple(value for value, _ in mine)))
                result.partial |= any(value is not None and not whole for value, whole in mine)
                differences = [
                    value - theirs if value is not None and whole else None
                    for (value, whole), theirs in zip(mine, values, strict=True)
                ]
                lines.append(Line("  ours − paper", tuple(differences), signed=True))
    return result


def text(found: Comparison, figures: Figures) -> str:
    """The comparison as Markdown."""
    table = found.table
    lines = [f"### Table {table.number}: {table.caption}", "", f"Published figures: {figures.source}."]
    heads = [_head(column, table.columns) for column in table.columns]
    for metric, rows in found.lines.items():
        title, form = TITLES[metric]
        body = [[row.title, *(_number(value, form, row.signed) for value in row.values)] for row in rows]
        lines += ["", *aligned([title, *heads], body)]
    if found.partial:
        lines += [
            "",
            "Averages of ours over a part of the scenes have no difference.",
        ]
    if not any(row.title.startswith("  ") for rows in found.lines.values() for row in rows):
        lines += ["", "No finished run is of a scene of this table."]
    for name, scenes in found.missing.items():
        if scenes:
            lines += ["", missing(name, scenes, figures)]
    return "\n".join(lines)


def missing(name: str, scenes: Iterable[str], figures: Figures) -> str:
    """What data is missing, and the names of the folders that it belongs into."""
    about = figures.data_sets[name]
    folders = ", ".join(f"{about['folder']}/{about['scenes'][scene][0]}" for scene in scenes)
    return f"Missing: {name} ({about['of']}): {', '.join(scenes)}. Its folders: {folders}; name them as DATA."


def _places(column: Place, figures: Figures) -> list[tuple[str, str]]:
    """The scenes that a column stands for."""
    if column.scene:
        return [(column.data_set, column.scene)]
    names = [column.data_set] if column.data_set else UNNAMED
    return [(name, scene) for name in names for scene in figures.data_sets[name]["scenes"]]


def _ours(
    metric: str, variant: str, places: list[tuple[str, str]], scenes: dict[tuple[str, str], Scene]
) -> tuple[float | None, bool]:
    """Our mean over the scenes that have it, and whether all have."""
    rows = [row for p in places if p in scenes for row in scenes[p].rows if row.variant == variant]
    values = [value for row in rows if (value := _figure(metric, row)) is not None]
    return (fmean(values) if values else None), len(values) == len(places)


def _figure(metric: str, row: Row) -> float | None:
    """A row's mean in the paper's unit."""
    key = {"train_hours": "train_seconds", "fps": "ms_per_frame"}.get(metric, metric)
    number = row.numbers.get(key)
    if number is None:
        return None
    return {"train_hours": number.mean / 3600, "fps": 1000 / number.mean}.get(metric, number.mean)


def _head(column: Place, columns: tuple[Place, ...]) -> str:
    """A column's title: with its data set where two have a scene of one name."""
    if not column.scene:
        return f"mean, {column.data_set}" if column.data_set else "mean"
    twice = sum(other.scene == column.scene for other in columns) > 1
    return f"{column.scene} ({column.data_set.split()[0]})" if twice else column.scene


def _number(value: float | None, form: str, signed: bool) -> str:
    return NOTHING if value is None else format(value, f"+{form}" if signed else form)
