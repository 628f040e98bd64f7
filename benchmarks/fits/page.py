"""Tables and numbers of a group of fits, by name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.common.report import Row, table, where
from benchmarks.fits.plan import SOURCES
from mi_refgs.compare.table import Statistic
from mi_refgs.errors import InputError
from mi_refgs.evaluation.scores import PIXEL_CLASSES

FORMS = {
    "normal_mae_deg": "{:.1f}°",
    "normal_mae_deg_concave": "{:.0f}°",
    "env_correlation": "{:.2f}",
    "surface_distance": "{:.2f} %",
    "roughness_mae": "{:.2f}",
    "metallic_mae": "{:.2f}",
    "train_minutes": "{:.1f} minutes",
    "surfels": "{:,.0f}",
}
"""How a number of a row is written; others are dB."""
NUMBERS = ("psnr", "psnr_samples", "psnr_region", "albedo_psnr", *FORMS)
Column = tuple[str, str, dict[str, Any]]  # title; key; the rows of which it is, by their values


def _columns(*names: str, **only: Any) -> list[Column]:
    return [(title, key, only) for title, _, key in (name.partition("=") for name in names)]


def _about(row: Row) -> str:
    return f"`{row['source']}`: {SOURCES[row['source']].about}"


def _fit(row: Row) -> str:
    return f"{_about(row)}, `{row['method']}`, `{row['preset']}`, threads: {row['threads']}"


SHAPE = ("normals=normal_mae_deg", "light, correlation=env_correlation", "surface distance=surface_distance")
MATERIALS = ("albedo=albedo_psnr", "metallic error=metallic_mae", "roughness error=roughness_mae")
TIME = ("surfels=surfels", "training=train_minutes")
TRIALS = ("SH alone=colour_alone", "twice the surfels=surfels_2x", "four times=surfels_4x")


def _rooms(_: list[Row]) -> list[Column]:
    return _columns("PSNR=psnr", "region=psnr_region", *SHAPE[:2], *MATERIALS, TIME[1])


TABLES: dict[str, tuple[Callable[[Row], str], Callable[[list[Row]], list[Column]]]] = {
    "front": (_fit, lambda rows: _columns("PSNR=psnr", *SHAPE[:2], *TIME)),
    "images": (
        _about,
        lambda rows: [
            *_columns("PSNR=psnr", "4 × 4 samples=psnr_samples", method="auto"),
            *_columns("2DGS, PSNR=psnr", "2DGS, normals=normal_mae_deg", method="base_2dgs"),
            *_columns(*SHAPE, *TIME, method="auto"),
        ],
    ),
    "decisions": (_fit, lambda rows: _columns(*TRIALS, "PSNR=psnr", *SHAPE[:2], *TIME)),
    "relighting": (
        _about,
        lambda rows: _columns(
            *("PSNR=psnr", *SHAPE, "normals, concave=normal_mae_deg_concave", *MATERIALS),
            *(f"relit: {name}=relit_{name}" for name in rows[0]["relit"]),
        ),
    ),
    "methods": (
        lambda row: f"`{row['method']}`",
        lambda rows: [
            column
            for name in dict.fromkeys(row["source"] for row in rows)
            for column in _columns(f"`{name}`=psnr", SHAPE[0], source=name)
        ],
    ),
    "photographs": (_fit, _rooms),
    "photographs_relighting": (_fit, _rooms),
}
"""Group → title of a row (those of one title share a line), and columns."""


def values(group: str, result: dict[str, Any]) -> dict[str, str]:
    """Return the tables of a group, and its numbers as SOURCE_METHOD_KEY, of the first row of both.

    budget_CLASS_KEY are the shares of the error budget of the first row.

    Raises InputError for rows of several builds.
    """
    if {row["build"] for row in result["rows"]} != {result["build"]["commit"]}:
        raise InputError(f"{group}.json: build: rows are of several builds; measure the group again")
    rows = [_flat(row) for row in result["rows"]]
    title, columns = TABLES[group]
    lines: dict[str, list[Row]] = {}
    for row in rows:
        lines.setdefault(title(row), []).append(row)
    chosen = columns(rows)
    body = [[name, *(_cell(where(of, **only), key) for _, key, only in chosen)] for name, of in lines.items()]
    found = {"table": table(["", *(head for head, _, _ in chosen)], body)}
    for row in reversed(rows):
        found |= {f"{row['source']}_{row['method']}_{key}": _cell([row], key) for key in NUMBERS}
    scores = [score for row in rows for score in row.get("relit", {}).values()]
    if relit := [score for score in scores if score is not None]:
        found |= {"relit_least": f"{min(relit):.1f} dB", "relit_most": f"{max(relit):.1f} dB"}
    if fine := rows[0].get("error_budget_samples"):
        budget = rows[0]["error_budget"]
        found["budget"] = _budget(budget, fine)
        for name, of in budget.items():
            found |= {f"budget_{name}_{key}": _share(of[key]) for key in ("pixels", "squared_error")}
    return found


def _flat(row: Row) -> Row:
    """The row with its minutes, relit scores and trials as entries."""
    found = row | {"train_minutes": row["train_seconds"] / 60}
    found |= {f"relit_{name}": score for name, score in row.get("relit", {}).items()}
    for trial in (trial for trial in row["decisions"] if trial["with_it"]):
        gain = trial["with_it"]["psnr"] - trial["without"]["psnr"]
        found[trial["component"]] = f"{gain:+.1f} dB: {'chosen' if trial['stays'] else 'left out'}"
    return found


def _cell(rows: list[Row], key: str) -> str:
    """A number with its unit, over seeds as mean ± standard deviation; empty where there is none."""
    found = [row[key] for row in rows if row.get(key) is not None]
    if not found or isinstance(found[0], str):
        return found[0] if found else ""
    number, form = Statistic.of(found), FORMS.get(key, "{:.1f} dB")
    return form.format(number.mean) + ("" if number.sd is None else f" ± {form.format(number.sd)}")


def _share(x: float) -> str:
    return f"{100 * x:.1f} %"


def _budget(budget: dict[str, Any], fine: dict[str, Any]) -> str:
    lines = []
    for name, found in budget.items():
        angle = _cell([found], "normal_mae_deg")
        squared = _share(found["squared_error"]), angle, _share(fine[name]["squared_error"])
        lines.append([PIXEL_CLASSES[name], _share(found["pixels"]), *squared])
    return table(["class", "pixels", "squared error", "normal error", "squared error, 4 × 4 samples"], lines)
