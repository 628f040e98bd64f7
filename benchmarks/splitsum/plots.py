"""The pictures of the page."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures, report
from benchmarks.common.errors import CLEAR
from benchmarks.common.select import Row, where
from benchmarks.splitsum import select

Result = dict[str, Any]


def plot(result: Result, folder: Path) -> None:
    """Write splitsum_NAME.png for each picture of the page."""
    made = {"pareto": pareto, "lights": over_lights, "trust": trust, "speedup": speedup, "budget": budget}
    for name, draw in made.items():
        figures.save(draw(result), folder / f"splitsum_{name}.png")


def pareto_light(result: Result) -> str:
    """The light of the plot over roughness: the studio, or the run's last built-in one before the sun."""
    names = select.lights(result)
    return "studio" if "studio" in names else names[-2] if len(names) > 1 else names[0]


def pareto(result: Result) -> Any:
    """Error over time, one panel a roughness."""
    light, shape = pareto_light(result), select.convex(result)[0]
    panels = {f"roughness {r:g}": (light, r) for r in result["settings"]["roughness"]}
    return _fronts(
        result, panels, 4, f"{shape}, light: {light}, metallic {select.picture_metallic(result):g}"
    )


def over_lights(result: Result) -> Any:
    """Error over time, one panel a light, at a middling roughness."""
    roughness = min(result["settings"]["roughness"], key=lambda r: abs(r - 0.3))
    panels = {light: (light, roughness) for light in select.lights(result)}
    shape = select.convex(result)[0]
    return _fronts(result, panels, 5, f"{shape}, roughness {roughness:g}, lights of rising frequency")


def _fronts(result: Result, panels: dict[str, tuple[str, float]], columns: int, title: str) -> Any:
    """All methods on one convex surface, a panel for each light and roughness."""
    figure, axes = figures.grid(list(panels), columns, 2.9, 2.6, "ms per megapixel", "relMSE")
    fixed = {"shape": select.convex(result)[0], "metallic": select.picture_metallic(result), "n_dot_v": "all"}
    for ax, (light, roughness) in zip(axes, panels.values(), strict=True):
        _front(ax, where(result["rows"], light=light, roughness=roughness, **fixed))
    figures.legend(figure, axes, f"{title} (grey: below the reference's noise)", 4)
    return figure


SAMPLED = {"path": ("o-", "Mitsuba path, spp"), "monte_carlo": ("s-", "plain Monte Carlo")}
MARKS = {"dominant": "D", "multiscatter": "x", "few_levels": "v", "many_levels": "^"}


def _front(ax: Any, cases: list[Row]) -> None:
    """All methods of one case."""
    for method, (style, label) in SAMPLED.items():
        known = [row for row in where(cases, method=method) if row["ms_per_mpx"]]
        spp = [row["setting"] if method == "path" else None for row in known]
        points = [(row["ms_per_mpx"], row["relmse"], n) for row, n in zip(known, spp, strict=True)]
        figures.series(ax, points, style, figures.COLOURS[method], label, markersize=3)
    split = [row for row in where(cases, method="split_sum") if row["ms_per_mpx"]]
    ends = {row["setting"] for row in (split[0], split[-1])}
    points = [_shown(row, row["setting"] if row["setting"] in ends else None) for row in split]
    figures.series(ax, points, "o", figures.COLOURS["split_sum"], "split sum, rows of light")
    for row in cases:
        option = row["method"].removeprefix("split_sum_")
        if option in MARKS and (row["setting"] == split[-1]["setting"] or option.endswith("levels")):
            look = {"markersize": 6, "fillstyle": "none"}
            name = option.replace("_", " ")
            figures.series(ax, [_shown(row, None)], MARKS[option], figures.COLOURS["option"], name, **look)
    floor = max((CLEAR * row["relmse_floor"] for row in cases), default=0)
    if floor:
        low = ax.get_ylim()[0]
        ax.axhspan(floor / 1e3, floor, color=figures.COLOURS["floor"], alpha=0.4, linewidth=0)
        ax.set_ylim(bottom=max(low, 1e-9))
    ax.margins(x=0.12)


def _shown(row: Row, text: Any) -> tuple[float, float, Any]:
    return row["ms_per_mpx"], select.shown_relmse(row), text


def budget(result: Result) -> Any:
    """relMSE of each approximation alone over roughness, one panel a shape and light."""
    budgets, names = result["budgets"], select.lights(result)
    shapes = list(dict.fromkeys(row["shape"] for row in budgets))
    metallic, height = (max(row[key] for row in budgets) for key in ("metallic", "height"))
    places = [(shape, light) for shape in shapes for light in names]
    titles = [f"{shape}, {light}" for shape, light in places]
    figure, axes = figures.grid(titles, len(names), 2.7, 2.2, "roughness", "relMSE")
    parts = list(dict.fromkeys(part["name"] for row in budgets for part in row["parts"]))
    for ax, (shape, light) in zip(axes, places, strict=True):
        cases = where(budgets, shape=shape, light=light, metallic=metallic, height=height)
        x = [row["roughness"] for row in cases]
        ax.plot(x, [row["total"] for row in cases], "k", linewidth=2, label="whole error")
        for k, name in enumerate(parts):
            y = [part["relmse"] for row in cases for part in row["parts"] if part["name"] == name]
            if y:
                ax.plot(x, y, "o-", markersize=2.5, linewidth=1, color=f"C{k}", label=name)
        ax.plot(x, [row["floor"] for row in cases], ":", color="grey", linewidth=1, label="noise")
        ax.set(yscale="log", ylim=(1e-8, 10))
    title = f"Error of each approximation alone, {height} rows of light, metallic {metallic:g}"
    figures.legend(figure, axes, title, 5)
    return figure


# ---------------- where ----------------


def trust(result: Result) -> Any:
    """√relMSE of the finest split sum by roughness and view angle, one panel a light."""
    names, views = select.lights(result), select.view_bins(result)
    title = (
        f"Typical relative error of the split sum ({select.best_height(result)} rows), percent:\n"
        "the worst convex shape and metal"
    )
    width = 0.5 * len(result["settings"]["roughness"]) + 0.4
    figure, axes = figures.grid(names, 3, width, 2.0, "roughness", "n·v")
    for ax, light in zip(axes, names, strict=True):
        cells = {view: functools.partial(select.trust, result, light, view=view) for view in views}
        image = _heat(ax, result, cells, _error, _percent, (1e-3, 1), "viridis_r")
    figure.colorbar(image, ax=axes, shrink=0.8, label="√relMSE")
    figure.suptitle(title, fontsize=10)
    return figure


def speedup(result: Result) -> Any:
    """Speed-up at equal error, the least over metals, one panel a shape."""
    names, shapes = select.lights(result), select.convex(result)
    width = 0.6 * len(result["settings"]["roughness"]) + 0.7
    figure, axes = figures.grid(shapes, len(shapes), width, 2.4, "roughness", "")
    for ax, shape in zip(axes, shapes, strict=True):
        cells = {light: functools.partial(least_speed_up, result, shape, light) for light in names}
        _heat(ax, result, cells, lambda row: row["speed_up"], speed_text, (1, 1e4), "viridis")
    figure.suptitle(
        "Time of Mitsuba's path tracer over that of the split sum at equal relMSE\n(the least of all metals)",
        fontsize=10,
    )
    return figure


def _heat(
    ax: Any,
    result: Result,
    lines: Mapping[str, Callable[[float], Any]],
    value: Callable[[Any], float],
    text: Callable[[Any], str],
    ends: tuple[float, float],
    colours: str,
) -> Any:
    """Rows by name as functions of roughness: the value of what each gives, and its text."""
    from matplotlib.colors import LogNorm

    roughness = result["settings"]["roughness"]
    cells = [[line(r) for r in roughness] for line in lines.values()]
    values = np.array([[value(cell) for cell in line] for line in cells])
    texts = [[text(cell) for cell in line] for line in cells]
    columns = [f"{r:g}" for r in roughness]
    return figures.heat(ax, values, texts, list(lines), columns, norm=LogNorm(*ends), cmap=colours)


def _error(row: Row | None) -> float:
    return float(np.sqrt(select.shown_relmse(row)) if row else np.nan)


def _percent(row: Row | None) -> str:
    if row is None:
        return ""
    value = 100 * _error(row)
    return "<" * row["below_floor"] + (f"{value:.1f}" if value < 9.95 else f"{value:.0f}")


def least_speed_up(result: Result, shape: str, light: str, roughness: float) -> Row:
    """Of the metals, for the finest light."""
    found = where(
        result["speed_ups"], shape=shape, light=light, roughness=roughness, height=select.best_height(result)
    )
    return min(found, key=lambda row: float(row["speed_up"]))


def speed_text(row: Row) -> str:
    """A speed-up; ">" where the split sum's error is lost in the noise."""
    value = row["speed_up"]
    text = report.number(value, 2) if value < 1e4 else f"{value:.0e}".replace("e+0", "e")
    return (">" if row["lower_bound"] else "") + text
