"""The pictures of the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures, report
from benchmarks.common.errors import CLEAR
from benchmarks.common.select import Row, where
from benchmarks.splitsum import select


def plot(result: dict[str, Any], folder: Path) -> None:
    """Write splitsum_NAME.png for each picture of the page."""
    made = {
        "pareto": pareto(result),
        "lights": over_lights(result),
        "trust": trust(result),
        "speedup": speedup(result),
        "budget": budget(result),
    }
    for name, figure in made.items():
        figures.save(figure, folder / f"splitsum_{name}.png")


def pareto_light(result: dict[str, Any]) -> str:
    """The light of the plot over roughness: the studio, or the run's last built-in one before the sun."""
    names = select.lights(result)
    return "studio" if "studio" in names else names[-2] if len(names) > 1 else names[0]


def pareto(result: dict[str, Any]) -> Any:
    """Error over time, one panel a roughness."""
    light, shape = pareto_light(result), select.convex(result)[0]
    panels = {f"roughness {r:g}": (light, r) for r in result["settings"]["roughness"]}
    return _fronts(
        result, panels, 4, f"{shape}, light: {light}, metallic {select.picture_metallic(result):g}"
    )


def over_lights(result: dict[str, Any]) -> Any:
    """Error over time, one panel a light, at a middling roughness."""
    roughness = min(result["settings"]["roughness"], key=lambda r: abs(r - 0.3))
    panels = {light: (light, roughness) for light in select.lights(result)}
    shape = select.convex(result)[0]
    return _fronts(result, panels, 5, f"{shape}, roughness {roughness:g}, lights of rising frequency")


def _fronts(result: dict[str, Any], panels: dict[str, tuple[str, float]], columns: int, title: str) -> Any:
    """All methods on one convex surface, a panel for each light and roughness."""
    rows = -(-len(panels) // columns)
    figure, axes = figures.new(rows, min(columns, len(panels)), 2.9, 2.6, sharex=True, sharey=True)
    fixed = {"shape": select.convex(result)[0], "metallic": select.picture_metallic(result), "n_dot_v": "all"}
    for ax, (name, (light, roughness)) in zip(axes.flat, panels.items(), strict=False):
        _front(ax, where(result["rows"], light=light, roughness=roughness, **fixed))
        ax.set_title(name, fontsize=9)
    for ax in axes.flat[len(panels) :]:
        ax.set_visible(False)
    for ax in axes[:, 0]:
        ax.set_ylabel("relMSE", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("ms per megapixel", fontsize=8)
    _legend(figure, axes, f"{title} (grey: below the reference's noise)", 4)
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


def _legend(figure: Any, axes: Any, title: str, columns: int) -> None:
    """One legend for all panels, and the title."""
    named: dict[str, Any] = {}
    for ax in axes.flat:
        named |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
    options = {"loc": "outside lower center", "ncols": columns, "fontsize": 8, "frameon": False}
    figure.legend(named.values(), named.keys(), **options)
    figure.suptitle(title, fontsize=10)


def budget(result: dict[str, Any]) -> Any:
    """relMSE of each approximation alone over roughness, one panel a shape and light."""
    budgets, names = result["budgets"], select.lights(result)
    shapes = list(dict.fromkeys(row["shape"] for row in budgets))
    metallic, height = max(row["metallic"] for row in budgets), max(row["height"] for row in budgets)
    figure, axes = figures.new(len(shapes), len(names), 2.7, 2.2, sharex=True, sharey=True)
    parts = list(dict.fromkeys(part["name"] for row in budgets for part in row["parts"]))
    for line, shape in zip(axes, shapes, strict=True):
        for ax, light in zip(line, names, strict=True):
            cases = where(budgets, shape=shape, light=light, metallic=metallic, height=height)
            x = [row["roughness"] for row in cases]
            ax.plot(x, [row["total"] for row in cases], "k", linewidth=2, label="whole error")
            for k, name in enumerate(parts):
                y = [part["relmse"] for row in cases for part in row["parts"] if part["name"] == name]
                if y:
                    ax.plot(x, y, "o-", markersize=2.5, linewidth=1, color=f"C{k}", label=name)
            ax.plot(x, [row["floor"] for row in cases], ":", color="grey", linewidth=1, label="noise")
            ax.set(yscale="log", ylim=(1e-8, 10))
            ax.set_title(f"{shape}, {light}", fontsize=9)
        line[0].set_ylabel("relMSE", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("roughness", fontsize=8)
    title = f"Error of each approximation alone, {height} rows of light, metallic {metallic:g}"
    _legend(figure, axes, title, 5)
    return figure


# ---------------- where ----------------


def trust(result: dict[str, Any]) -> Any:
    """√relMSE of the finest split sum by roughness and view angle, one panel a light."""
    from matplotlib.colors import LogNorm

    names, views = select.lights(result), select.view_bins(result)
    roughness = list(result["settings"]["roughness"])
    columns = min(3, len(names))
    figure, axes = figures.new(
        -(-len(names) // columns), columns, 0.5 * len(roughness) + 0.4, 2.0, sharey=True, sharex=True
    )
    for ax, light in zip(axes.flat, names, strict=False):
        cells = [[select.trust(result, light, r, view) for r in roughness] for view in views]
        values = np.array(
            [[np.sqrt(select.shown_relmse(c)) if c else np.nan for c in line] for line in cells]
        )
        texts = [[_percent(c) for c in line] for line in cells]
        image = figures.heat(
            ax, values, texts, views, [f"{r:g}" for r in roughness], norm=LogNorm(1e-3, 1), cmap="viridis_r"
        )
        ax.set_title(light, fontsize=9)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax in axes[-1]:
        ax.set_xlabel("roughness", fontsize=8)
    for ax in axes[:, 0]:
        ax.set_ylabel("n·v", fontsize=8)
    figure.colorbar(image, ax=axes, shrink=0.8, label="√relMSE")
    figure.suptitle(
        f"Typical relative error of the split sum ({select.best_height(result)} rows), percent:\n"
        "the worst convex shape and metal",
        fontsize=10,
    )
    return figure


def _percent(row: Row | None) -> str:
    if row is None:
        return ""
    sign = "<" if row["below_floor"] else ""
    value = 100 * np.sqrt(select.shown_relmse(row))
    return f"{sign}{value:.1f}" if value < 9.95 else f"{sign}{value:.0f}"


def speedup(result: dict[str, Any]) -> Any:
    """Speed-up at equal error, the least over metals, one panel a shape."""
    from matplotlib.colors import LogNorm

    names, shapes = select.lights(result), select.convex(result)
    roughness = list(result["settings"]["roughness"])
    figure, axes = figures.new(1, len(shapes), 0.6 * len(roughness) + 0.7, 2.4, sharey=True)
    for ax, shape in zip(axes.flat, shapes, strict=True):
        cells = [[least_speed_up(result, shape, light, r) for r in roughness] for light in names]
        values = np.array([[cell["speed_up"] for cell in line] for line in cells])
        texts = [[speed_text(cell) for cell in line] for line in cells]
        figures.heat(
            ax, values, texts, names, [f"{r:g}" for r in roughness], norm=LogNorm(1, 1e4), cmap="viridis"
        )
        ax.set_title(shape, fontsize=9)
        ax.set_xlabel("roughness", fontsize=8)
    figure.suptitle(
        "Time of Mitsuba's path tracer over that of the split sum at equal relMSE\n(the least of all metals)",
        fontsize=10,
    )
    return figure


def least_speed_up(result: dict[str, Any], shape: str, light: str, roughness: float) -> Row:
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
