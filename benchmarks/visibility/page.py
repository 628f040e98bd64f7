"""Tables, numbers and plots of the page, and the settings that are worth their time."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures
from benchmarks.common.errors import above_noise, budget_table, interactions
from benchmarks.common.report import Row, number, signed, table, where

MIRROR = "mirror ray"
"""One mirror ray for the whole lobe and no indirect light: what the price is a multiple of."""
PAPER = "harmonics"
"""Budget of the paper's rule: one mirror ray, indirect light by the best-fit spherical harmonics."""
BUDGET = 3.0
"""Times of the mirror ray alone that a setting may take."""
TIMES = ("ms", "frame_ms")
"""Times of visibility and shading on a mesh, and of the product's frame of surfels."""


def tradeoffs(rows: list[Row], budgets: list[Row]) -> list[Row]:
    """For each scene, roughness and kind of time: a setting within the budget, and what it gains.

    The setting is chosen on the other scenes: of those within the budget here, the one of the least mean
    logarithm of relMSE there, over all roughness. With one scene only, it is chosen on that scene. Errors are
    those against the path tracer at full depth; `gain` is the ratio of relMSE of the paper's rule and of the
    setting, `best_gain` that of the best setting in hindsight, `price` the ratio of times.
    """
    found = []
    names = list(dict.fromkeys(row["scene"] for row in rows))
    for case in dict.fromkeys((row["scene"], row["roughness"]) for row in rows):
        full = where(rows, scene=case[0], roughness=case[1], depth="full")
        mirror = where(full, method=MIRROR)[0]
        (paper,) = where(budgets, scene=case[0], roughness=case[1], indirect=PAPER)
        others = [name for name in names if name != case[0]] or names
        elsewhere = where(rows, scene=others, depth="full")
        for key in TIMES:
            affordable = [row for row in full if row[key] is not None and row[key] <= BUDGET * mirror[key]]
            chosen = min(affordable, key=lambda row: _mean_log(where(elsewhere, method=row["method"])))
            found.append(
                {
                    "scene": case[0],
                    "roughness": case[1],
                    "time": key,
                    "method": chosen["method"],
                    "gain": paper["total"] / chosen["relmse"],
                    "best_gain": paper["total"] / min(row["relmse"] for row in affordable),
                    "price": chosen[key] / mirror[key],
                    "mirror_relmse": mirror["relmse"],
                    "paper_relmse": paper["total"],
                    "relmse": chosen["relmse"],
                }
            )
    return found


def _mean_log(rows: list[Row]) -> float:
    # The floor keeps an exact setting finite.
    return float(np.mean([np.log(max(row["relmse"], 1e-12)) for row in rows]))


WHAT = dict(zip(TIMES, ("shading the mesh", "the product's frame"), strict=True))
DEPTHS = {"direct": "depth 2", "full": "full depth"}


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    s, budgets = result["settings"], above_noise(result["budgets"])
    mirror = where(result["rows"], depth="full", method=MIRROR)
    none = where(result["rows"], depth="full", rays=0)
    frame = _summary(where(result["tradeoffs"], time="frame_ms"))
    return {
        "scenes": table(
            ["scene", "pixels", "triangles", "surfels"],
            [[name, *(f"{fact[k]:,}" for k in fact)] for name, fact in result["scenes"].items()],
        ),
        "summary": table(
            ["by the time of", "smaller in", "median ratio", "least", "most"],
            [[WHAT[key], *_summary(where(result["tradeoffs"], time=key))] for key in TIMES],
        ),
        **dict(zip(("smaller", "median", "least", "most"), frame, strict=True)),
        "gains": _gains(result["tradeoffs"]),
        "limits": _limits(result),
        "rules": "\n\n".join(_rules(result, scene) for scene in result["scenes"]),
        "curve": _curve(result["curve"]),
        "harmonics": _budgets(where(result["budgets"], indirect="harmonics")),
        "traced": _budgets([row for row in result["budgets"] if row["indirect"] != "harmonics"]),
        "interactions": interactions(result["budgets"]),
        "budgets": len(budgets),
        "add_up": sum(row["adds_up"] for row in budgets),
        "worse_than_none": sum(a["relmse"] > b["relmse"] for a, b in zip(mirror, none, strict=True)),
        "cases": len(mirror),
        "spp": f"{s['spp'] * s['batches']:,}",
        "rays": max([*s["rays"], *s["more_rays"]]),
        "bounces": max(s["bounces"]),
        "options": "".join(f" --mesh {Path(name).name}" for name in s["meshes"]),
    }


def _case(row: Row) -> str:
    return f"{row['scene']}, roughness {row['roughness']:g}"


def _summary(found: list[Row]) -> list[str]:
    low, high = (pick(found, key=lambda row: float(row["gain"])) for pick in (min, max))
    median = float(np.median([row["gain"] for row in found]))
    ends = [f"{number(row['gain'], 2)}× ({_case(row)})" for row in (low, high)]
    return [f"{sum(row['gain'] > 1 for row in found)} of {len(found)}", f"{number(median, 2)}×", *ends]


def _gains(tradeoffs: list[Row]) -> str:
    head = ["case", "time of", "setting", "relMSE, mirror ray alone", "with SH", "with the setting"]
    rows = [
        [
            _case(row),
            WHAT[row["time"]],
            row["method"],
            *(number(row[key]) for key in ("mirror_relmse", "paper_relmse", "relmse")),
            *(f"{number(row[key])}×" for key in ("gain", "best_gain")),
            f"{number(row['price'], 2)}×",
        ]
        for row in tradeoffs
    ]
    return table([*head, "gain", "in hindsight", "price"], rows)


def _limits(result: dict[str, Any]) -> str:
    """Errors with the most rays where the setting within the budget is worse than SH."""
    most, rows = max(result["settings"]["bounces"]), []
    for case in where(result["tradeoffs"], time="frame_ms"):
        if case["gain"] < 1:
            found = where(result["rows"], scene=case["scene"], roughness=case["roughness"], dominant=False)
            rays = max(int(row["rays"]) for row in found if row["bounces"])
            cells = [
                where(found, rays=rays, depth=depth, bounces=n)[0]
                for depth, n in (("bounce", 1), ("full", most))
            ]
            rows.append([_case(case), rays, *map(_cell, cells)])
    return table(["case", "rays", "1 bounce at depth 3", f"{most} bounces at full depth"], rows)


def _rules(result: dict[str, Any], scene: str) -> str:
    """Every rule that is timed, at both depths."""
    roughness, rows = list(result["settings"]["roughness"]), []
    for depth, name in DEPTHS.items():
        found = [row for row in where(result["rows"], scene=scene, depth=depth) if row["ms"] is not None]
        for method in dict.fromkeys(row["method"] for row in found if depth == "full" or not row["bounces"]):
            by = {row["roughness"]: row for row in where(found, method=method)}
            times = (number(by[roughness[0]][key]) for key in TIMES)
            rows.append([method, name, *(_cell(by[r]) for r in roughness), *times])
    head = ["rule", "reference", *(f"r = {r:g}" for r in roughness), "shading, ms", "frame, ms"]
    return f"### {scene}\n\n{table(head, rows)}"


def _cell(row: Row) -> str:
    return f"{'< ' * row['below_floor']}{number(row['relmse'], 2)} ({signed(row['bias'])})"


def _curve(curve: list[Row]) -> str:
    counts, rows = list(dict.fromkeys(row["rays"] for row in curve)), []
    for scene, roughness in dict.fromkeys((row["scene"], row["roughness"]) for row in curve):
        found = where(curve, scene=scene, roughness=roughness)
        cells = [row["visibility_rms"] for row in found] + [found[0]["visibility_floor"]]
        rows.append([f"{scene}, r = {roughness:g}", *(number(x, 2) for x in cells)])
    return table(["case", *(f"k = {k}" for k in counts), "noise"], rows)


def _budgets(budgets: list[Row]) -> str:
    """A table for each kind of indirect light."""
    tables = []
    for name in dict.fromkeys(row["indirect"] for row in budgets):
        cases = [(f"{row['scene']}, r = {row['roughness']:g}", row) for row in where(budgets, indirect=name)]
        title = "Spherical harmonics" if name == PAPER else name[0].upper() + name[1:]
        tables.append(f"**{title}**\n\n{budget_table('case', cases)}")
    return "\n\n".join(tables)


RAYS_ONLY = "#c77b30"
BOUNCES = ("#9ecae1", "#4292c6", "#08306b", "#6a51a3")
"""Colours of rising numbers of bounces."""
MARKERS = {False: "o", True: "^"}
"""By `dominant`."""
SHADES = ("#9ecae1", "#4292c6", "#08306b")


def plot(result: dict[str, Any], folder: Path) -> Path:
    """Write visibility_convergence.png."""
    scenes = list(result["scenes"])
    figure, axes = figures.new(2, len(scenes), 3.9, 3.2)
    values = list(result["settings"]["roughness"])
    roughness = values[len(values) // 2]  # of the plot of error over time
    for column, scene in enumerate(scenes):
        _speed(axes[0, column], result, scene, roughness)
        _convergence(axes[1, column], result, scene)
    for row in axes:
        row[0].legend(fontsize=6, framealpha=0.9, edgecolor="none", handlelength=3)
    return figures.save(figure, folder / "visibility_convergence.png")


def _speed(ax: Any, result: dict[str, Any], scene: str, roughness: float) -> None:
    from matplotlib import ticker

    rows = where(result["rows"], scene=scene, roughness=roughness, depth="full")
    timed = [row for row in rows if row["ms"] is not None]
    for bounces, dominant in dict.fromkeys((row["bounces"], row["dominant"]) for row in timed):
        found = [row for row in where(timed, bounces=bounces, dominant=dominant) if row["rays"]]
        points = [(row["ms"], row["relmse"], None if dominant else row["rays"]) for row in found]
        rank = list(result["settings"]["bounces"]).index(bounces) if bounces else 0
        colour = BOUNCES[rank % len(BOUNCES)] if bounces else RAYS_ONLY
        label = f"{bounces} bounce{'s' * (bounces > 1)}" if bounces else "rays only"
        figures.series(ax, points, MARKERS[dominant], colour, label + ", dominant" * dominant)
    none, mirror = where(timed, rays=0)[0], where(timed, method=MIRROR)[0]
    ax.plot(none["ms"], none["relmse"], "x", color="#444444", label="no occlusion")
    ax.axhline(mirror["relmse"], color="#bbbbbb", lw=0.8, zorder=0)
    ax.set(xlabel="ms per frame", title=f"{scene}, roughness {roughness:g}")
    ax.set_ylabel("relMSE at full depth")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_minor_formatter(ticker.LogFormatterSciNotation(minor_thresholds=(1.2, 0.3)))
        axis.set_tick_params(which="minor", labelsize=6)


def _convergence(ax: Any, result: dict[str, Any], scene: str) -> None:
    values = list(result["settings"]["roughness"])
    for k, roughness in enumerate(values):
        rows = where(result["curve"], scene=scene, roughness=roughness)
        colour = SHADES[k % len(SHADES)]
        near = [(row["rays"], row["visibility_rms"], None) for row in rows]
        image = [(row["rays"], row["to_limit"] ** 0.5, None) for row in rows[:-1]]
        figures.series(ax, near, "o-", colour, f"visibility, r = {roughness:g}", markersize=3)
        figures.series(ax, image, "s--", colour, f"traced image, r = {roughness:g}", markersize=3)
        ax.axhline(rows[0]["visibility_floor"], color=colour, lw=0.8, ls=":", zorder=0)
    ax.set(xlabel="specular-lobe samples", ylabel="distance to the traced answer")
    ax.set_title(scene)
