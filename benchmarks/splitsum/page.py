"""Tables, numbers and plots of the page."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures, report
from benchmarks.common.errors import CLEAR, above_noise, budget_table, interactions
from benchmarks.common.report import Row, floored, number, percent, signed, table, where
from benchmarks.common.view import SUN_ELEVATION
from benchmarks.splitsum.setup import CONVEX

PICTURE_METALLIC = 0.5
"""Plots of speed against error show this metal: half diffuse, half mirror."""


def shown_relmse(row: Row) -> float:
    """relMSE, or the floor it hides below."""
    return float(max(row["relmse"], CLEAR * row["relmse_floor"]))


def best_height(result: dict[str, Any]) -> int:
    """The finest light."""
    return int(max(result["settings"]["heights"]))


def shown_metallic(result: dict[str, Any]) -> float:
    """The metal that plots show, if it was measured."""
    found = list(result["settings"]["metallic"])
    return PICTURE_METALLIC if PICTURE_METALLIC in found else float(found[-1])


def convex(result: dict[str, Any]) -> list[str]:
    """The convex shapes of the run."""
    return [shape for shape in result["settings"]["shapes"] if shape in CONVEX]


def lights(result: dict[str, Any]) -> list[str]:
    """The run's lights by name, in the order of their frequency."""
    frequencies: dict[str, float] = result["frequencies"]
    return sorted(frequencies, key=lambda name: frequencies[name])


def view_bins(result: dict[str, Any]) -> list[str]:
    """Names of the ranges of n·v, grazing first."""
    names = {row["n_dot_v"] for row in result["rows"]} - {"all"}
    return sorted(names, key=lambda name: float(name.partition("-")[0]))


def finest(result: dict[str, Any], light: str, roughness: float, view: str = "all") -> list[Row]:
    """The split sum's rows of the convex shapes and all metals, for the finest light."""
    chosen = {"method": "split_sum", "setting": best_height(result), "n_dot_v": view}
    return where(result["rows"], light=light, roughness=roughness, shape=convex(result), **chosen)


def trust(result: dict[str, Any], light: str, roughness: float, view: str = "all") -> Row | None:
    """The row of the largest relMSE, over shapes and metals, for the finest light."""
    rows = finest(result, light, roughness, view)
    return max(rows, key=lambda row: float(row["relmse"]), default=None)


BUDGET_SHOWN = (0.1, 0.3, 0.8)
"""Roughness of the budgets' tables, or the nearest ones measured."""


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    s, height = result["settings"], best_height(result)
    names, budgets = lights(result), result["budgets"]
    scores = np.array([row["score"] for row in result["scores"]])
    slopes = [row["path_exponent"] for row in result["speed_ups"] if row["path_exponent"] is not None]
    varying = [name for name in names if result["frequencies"][name] > 0]
    ratios = [row["speed_up"] for row in where(result["speed_ups"], height=height, light=varying)]
    worst = {light: [trust(result, light, r) for r in s["roughness"]] for light in names}
    clear = above_noise(budgets)
    return {
        "lights": table(
            ["light", "gradient, 1/radian"], [[f"`{x}`", number(result["frequencies"][x])] for x in names]
        ),
        "shapes": ", ".join(f"{name} ({count} pixels)" for name, count in result["pixels"].items()),
        "roughness": ", ".join(f"{r:g}" for r in s["roughness"]),
        "metallic": ", ".join(f"{m:g}" for m in s["metallic"]),
        "trust": _by_roughness(result, ((f"`{x}`", worst[x]) for x in names), cell),
        "bias": _by_roughness(
            result,
            ((f"`{x}`", [_bias(result, x, r) for r in s["roughness"]]) for x in names),
            lambda row: signed(row["bias"], CLEAR * row["bias_floor"]),
        ),
        "speed": _by_roughness(
            result,
            (
                (f"{shape}, `{light}`", [least_speed_up(result, shape, light, r) for r in s["roughness"]])
                for shape in convex(result)
                for light in names
            ),
            speed_text,
        ),
        "price": _price(result),
        "dominant": _dominant(result),
        "mesh_budgets": _budgets(result),
        "interactions": interactions(budgets),
        "surfel_budgets": budget_table(
            "light", [(f"`{row['light']}`", row) for row in result["surfel_budgets"]]
        ),
        "height": height,
        "sun": f"{SUN_ELEVATION:g}",
        "median_speed": number(float(np.median(ratios)), 2),
        "low_speed": number(float(np.quantile(ratios, 0.1)), 2),
        "score_spread": f"{scores.std():.2f}",
        "score_largest": f"{np.abs(scores).max():.1f}",
        "score_cases": len(scores),
        "path_power": f"{np.median(slopes):.2f}",
        "budgets": len(clear),
        "add_up": sum(row["adds_up"] for row in clear),
        "surfels": f"{s['surfels']:,}",
        "covered": percent(min(row["covered"] for row in result["surfel_budgets"])),
        "price_case": f"{convex(result)[0]} under `{pareto_light(result)}`, "
        f"metallic {shown_metallic(result):g}",
    }


def cell(row: Row | None) -> str:
    """√relMSE, or its floor."""
    return floored(row["relmse"], row["relmse_floor"], CLEAR) if row else "–"


def _by_roughness(
    result: dict[str, Any], cases: Iterable[tuple[str, list[Any]]], show: Callable[[Any], str]
) -> str:
    """A line for each case, a column for each roughness."""
    head = ["case", *(f"r = {r:g}" for r in result["settings"]["roughness"])]
    return table(head, [[label, *map(show, cells)] for label, cells in cases])


def _bias(result: dict[str, Any], light: str, roughness: float) -> Row:
    """The convex shape and metal of the largest bias, for the finest light."""
    return max(finest(result, light, roughness), key=lambda row: abs(float(row["bias"])))


def _price(result: dict[str, Any]) -> str:
    """Resolution, levels and options: error and time of one surface."""
    prefilter = {(row["method"], row["height"]): row["ms"] for row in result["prefilter_ms"]}
    found = where(
        result["rows"],
        shape=convex(result)[0],
        light=pareto_light(result),
        metallic=shown_metallic(result),
        n_dot_v="all",
    )
    rows = []
    methods = {(r["method"], r["setting"]): None for r in found if r["method"].startswith("split_sum")}
    for method, height in methods:
        cells = where(found, method=method, setting=height)
        name = method.removeprefix("split_sum").strip("_").replace("_", " ") or "shipped"
        cost = prefilter.get((method, height), prefilter.get(("split_sum", height)))
        times = (number(cells[0]["ms_per_mpx"]), number(cost))
        rows.append([f"{name}, {height} rows", *map(cell, cells), *times])
    head = ["split sum", *(f"r = {r:g}" for r in result["settings"]["roughness"])]
    return table([*head, "ms/Mpx", "prefilter, ms"], rows)


def _dominant(result: dict[str, Any]) -> str:
    """By roughness: what the dominant direction multiplies relMSE by."""
    keys = ("shape", "light", "roughness", "metallic")
    plain, turned = (
        {
            tuple(row[k] for k in keys): row
            for row in where(result["rows"], method=m, setting=best_height(result), n_dot_v="all")
        }
        for m in ("split_sum", "split_sum_dominant")
    )
    factors: dict[float, list[float]] = {r: [] for r in result["settings"]["roughness"]}
    for key, row in turned.items():
        if not row["below_floor"] and not plain[key]["below_floor"]:
            factors[row["roughness"]].append(row["relmse"] / plain[key]["relmse"])
    rows = [
        [f"{r:g}", f"{np.median(found):.2f}", f"{sum(x < 1 for x in found)} of {len(found)}"]
        for r, found in factors.items()
        if found
    ]
    return table(["roughness", "relMSE times, median", "lower in"], rows)


def _budgets(result: dict[str, Any]) -> str:
    """Budgets of the most metallic material: a table for each shape, for the first one at both heights."""
    budgets, order = result["budgets"], lights(result)
    if not budgets:
        return table([], [])
    metallic = max(row["metallic"] for row in budgets)
    shown = sorted({min(result["settings"]["roughness"], key=lambda r: abs(r - x)) for x in BUDGET_SHOWN})
    heights = sorted({row["height"] for row in budgets})
    tables = []
    for shape in dict.fromkeys(row["shape"] for row in budgets):
        for height in heights if shape == budgets[0]["shape"] else heights[-1:]:
            cases = where(budgets, shape=shape, metallic=metallic, height=height, roughness=shown)
            cases.sort(key=lambda row: (order.index(row["light"]), row["roughness"]))
            labelled = [(f"`{row['light']}`, r = {row['roughness']:g}", row) for row in cases]
            tables.append(f"**{shape}, metallic {metallic:g}, {height} rows of light**")
            tables.append(budget_table("case", labelled))
    return "\n\n".join(tables)


Result = dict[str, Any]


def plot(result: Result, folder: Path) -> None:
    """Write splitsum_NAME.png for each image of the page."""
    made = {"pareto": pareto_plot, "lights": over_lights, "trust": trust_plot, "speedup": speedup_plot}
    for name, draw in (made | {"budget": budget_plot}).items():
        figures.save(draw(result), folder / f"splitsum_{name}.png")


def pareto_light(result: Result) -> str:
    """The light of the plot over roughness: the studio, or the run's last built-in one before the sun."""
    names = lights(result)
    return "studio" if "studio" in names else names[-2] if len(names) > 1 else names[0]


def pareto_plot(result: Result) -> Any:
    """Error over time, one panel a roughness."""
    light, shape = pareto_light(result), convex(result)[0]
    panels = {f"roughness {r:g}": (light, r) for r in result["settings"]["roughness"]}
    return _fronts(result, panels, 4, f"{shape}, light: {light}, metallic {shown_metallic(result):g}")


def over_lights(result: Result) -> Any:
    """Error over time, one panel a light, at a middling roughness."""
    roughness = min(result["settings"]["roughness"], key=lambda r: abs(r - 0.3))
    panels = {light: (light, roughness) for light in lights(result)}
    shape = convex(result)[0]
    return _fronts(result, panels, 5, f"{shape}, roughness {roughness:g}, lights of rising frequency")


def _fronts(result: Result, panels: dict[str, tuple[str, float]], columns: int, title: str) -> Any:
    """All methods on one convex surface, a panel for each light and roughness."""
    figure, axes = figures.grid(list(panels), columns, 2.9, 2.6, "ms per megapixel", "relMSE")
    fixed = {"shape": convex(result)[0], "metallic": shown_metallic(result), "n_dot_v": "all"}
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
    return row["ms_per_mpx"], shown_relmse(row), text


def budget_plot(result: Result) -> Any:
    """relMSE of each approximation alone over roughness, one panel a shape and light."""
    budgets, names = result["budgets"], lights(result)
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


def trust_plot(result: Result) -> Any:
    """√relMSE of the finest split sum by roughness and view angle, one panel a light."""
    names, views = lights(result), view_bins(result)
    title = (
        f"Typical relative error of the split sum ({best_height(result)} rows), percent:\n"
        "the worst convex shape and metal"
    )
    width = 0.5 * len(result["settings"]["roughness"]) + 0.4
    figure, axes = figures.grid(names, 3, width, 2.0, "roughness", "n·v")
    for ax, light in zip(axes, names, strict=True):
        cells = {view: functools.partial(trust, result, light, view=view) for view in views}
        image = _heat(ax, result, cells, _error, _percent, (1e-3, 1), "viridis_r")
    figure.colorbar(image, ax=axes, shrink=0.8, label="√relMSE")
    figure.suptitle(title, fontsize=10)
    return figure


def speedup_plot(result: Result) -> Any:
    """Speed-up at equal error, the least over metals, one panel a shape."""
    names, shapes = lights(result), convex(result)
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
    return float(np.sqrt(shown_relmse(row)) if row else np.nan)


def _percent(row: Row | None) -> str:
    if row is None:
        return ""
    value = 100 * _error(row)
    return "<" * row["below_floor"] + (f"{value:.1f}" if value < 9.95 else f"{value:.0f}")


def least_speed_up(result: Result, shape: str, light: str, roughness: float) -> Row:
    """The least speed-up of the metals, for the finest light."""
    found = where(
        result["speed_ups"], shape=shape, light=light, roughness=roughness, height=best_height(result)
    )
    return min(found, key=lambda row: float(row["speed_up"]))


def speed_text(row: Row) -> str:
    """A speed-up; ">" where the split sum's error is lost in the noise."""
    value = row["speed_up"]
    text = report.number(value, 2) if value < 1e4 else f"{value:.0e}".replace("e+0", "e")
    return (">" if row["lower_bound"] else "") + text
