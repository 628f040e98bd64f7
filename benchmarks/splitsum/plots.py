"""The pictures of the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures, report
from benchmarks.common.errors import CLEAR
from benchmarks.common.select import Row, where
from benchmarks.splitsum import select
from benchmarks.splitsum.plot_budget import budget


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


# ---------------- speed against error ----------------


def pareto_light(result: dict[str, Any]) -> str:
    """The light of the plot over roughness: the studio, or the run's last built-in one before the sun."""
    names = select.lights(result)
    return "studio" if "studio" in names else names[-2] if len(names) > 1 else names[0]


def pareto(result: dict[str, Any]) -> Any:
    """Error over time, one panel a roughness."""
    roughness = list(result["settings"]["roughness"])
    columns = min(4, len(roughness))
    rows = -(-len(roughness) // columns)
    figure, axes = figures.new(rows, columns, 3.0, 2.6, sharex=True, sharey=True)
    light, shape = pareto_light(result), select.convex(result)[0]
    for ax, r in zip(axes.flat, roughness, strict=False):
        _front(ax, _cases(result, shape, light, r))
        ax.set_title(f"roughness {r:g}", fontsize=9)
    for ax in axes.flat[len(roughness) :]:
        ax.set_visible(False)
    _finish(figure, axes, f"{shape}, light: {light}, metallic {select.picture_metallic(result):g}")
    return figure


def over_lights(result: dict[str, Any]) -> Any:
    """Error over time, one panel a light, at a middling roughness."""
    names = select.lights(result)
    roughness = min(result["settings"]["roughness"], key=lambda r: abs(r - 0.3))
    figure, axes = figures.new(1, len(names), 2.8, 2.7, sharex=True, sharey=True)
    shape = select.convex(result)[0]
    for ax, light in zip(axes.flat, names, strict=True):
        _front(ax, _cases(result, shape, light, roughness))
        ax.set_title(light, fontsize=9)
    _finish(figure, axes, f"{shape}, roughness {roughness:g}, lights of rising frequency")
    return figure


def _cases(result: dict[str, Any], shape: str, light: str, roughness: float) -> list[Row]:
    """All methods on one surface."""
    metallic = select.picture_metallic(result)
    return where(
        result["rows"], shape=shape, light=light, roughness=roughness, metallic=metallic, n_dot_v="all"
    )


def _front(ax: Any, cases: list[Row]) -> None:
    """All methods of one case on logarithmic axes."""
    for method, marker, label in (
        ("path", "o", "Mitsuba path, spp"),
        ("monte_carlo", "s", "plain Monte Carlo"),
    ):
        known = [row for row in where(cases, method=method) if row["ms_per_mpx"]]
        ax.plot(
            [row["ms_per_mpx"] for row in known],
            [row["relmse"] for row in known],
            marker + "-",
            color=figures.COLOURS[method],
            markersize=3,
            linewidth=1,
            label=label,
        )
        if method == "path":
            for row in known:
                ax.annotate(
                    f"{row['setting']}",
                    (row["ms_per_mpx"], row["relmse"]),
                    xytext=(3, 3),
                    textcoords="offset points",
                    fontsize=6,
                )
    split = [row for row in where(cases, method="split_sum") if row["ms_per_mpx"]]
    ax.plot(
        [row["ms_per_mpx"] for row in split],
        [select.shown_relmse(row) for row in split],
        "o",
        color=figures.COLOURS["split_sum"],
        markersize=4,
        label="split sum, rows of light",
    )
    for row in (split[0], split[-1]) if split else ():
        ax.annotate(
            f"{row['setting']}",
            (row["ms_per_mpx"], select.shown_relmse(row)),
            xytext=(-4, -2),
            textcoords="offset points",
            ha="right",
            fontsize=6,
            color=figures.COLOURS["split_sum"],
        )
    finest = max((row["setting"] for row in split), default=0)
    for row in cases:
        knob = row["method"].removeprefix("split_sum_")
        if knob in MARKS and (row["setting"] == finest or knob.endswith("levels")):
            ax.plot(
                [row["ms_per_mpx"]],
                [select.shown_relmse(row)],
                MARKS[knob],
                color=figures.COLOURS["knob"],
                markersize=6,
                fillstyle="none",
                label=knob.replace("_", " "),
            )
    floor = max((CLEAR * row["relmse_floor"] for row in cases), default=0)
    if floor:
        ax.axhspan(floor / 1e3, floor, color=figures.COLOURS["floor"], alpha=0.4, linewidth=0)
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.margins(x=0.12)


MARKS = {"dominant": "D", "multiscatter": "x", "few_levels": "v", "many_levels": "^"}


def _finish(figure: Any, axes: Any, title: str) -> None:
    low, high = [], []
    for ax in axes.flat:
        values = np.concatenate([line.get_ydata() for line in ax.lines] or [np.ones(1)]).astype(float)
        values = values[values > 0]
        low.append(values.min())
        high.append(values.max())
    axes.flat[0].set_ylim(max(min(low) / 4, 1e-9), min(max(high) * 3, 1e3))
    for ax in axes[:, 0]:
        ax.set_ylabel("relMSE", fontsize=8)
    for ax in axes[-1]:
        ax.set_xlabel("ms per megapixel", fontsize=8)
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=8, frameon=False)
    figure.suptitle(f"{title} (grey: below the reference's noise)", fontsize=10)


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
            ax,
            values,
            texts,
            names,
            [f"{r:g}" for r in roughness],
            norm=LogNorm(1, 1e4),
            cmap="viridis",
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
        result["speed_ups"],
        shape=shape,
        light=light,
        roughness=roughness,
        height=select.best_height(result),
    )
    return min(found, key=lambda row: float(row["speed_up"]))


def speed_text(row: Row) -> str:
    """A speed-up; ">" where the split sum's error is lost in the noise."""
    value = row["speed_up"]
    text = report.number(value, 2) if value < 1e4 else f"{value:.0e}".replace("e+0", "e")
    return (">" if row["lower_bound"] else "") + text
