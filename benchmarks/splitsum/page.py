"""What a run fills into the page: its tables and a few numbers."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from benchmarks.common.budget import above_noise, budget_table, interactions
from benchmarks.common.errors import CLEAR
from benchmarks.common.lights import SUN_ELEVATION
from benchmarks.common.report import floored, number, percent, signed, table
from benchmarks.common.select import Row, where
from benchmarks.splitsum import select
from benchmarks.splitsum.plots import least_speed_up, pareto_light, speed_text

BUDGET_SHOWN = (0.1, 0.3, 0.8)
"""Roughness of the budgets' tables, or the nearest ones measured."""


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    s, height = result["settings"], select.best_height(result)
    lights, budgets = select.lights(result), result["budgets"]
    scores = np.array([row["score"] for row in result["scores"]])
    slopes = [row["path_exponent"] for row in result["speed_ups"] if row["path_exponent"] is not None]
    varying = [name for name in lights if result["frequencies"][name] > 0]
    ratios = [row["speed_up"] for row in where(result["speed_ups"], height=height, light=varying)]
    worst = {light: [_trust(result, light, r) for r in s["roughness"]] for light in lights}
    clear = above_noise(budgets)
    return {
        "lights": table(
            ["light", "gradient, 1/radian"], [[f"`{x}`", number(result["frequencies"][x])] for x in lights]
        ),
        "shapes": ", ".join(f"{name} ({count} pixels)" for name, count in result["pixels"].items()),
        "roughness": ", ".join(f"{r:g}" for r in s["roughness"]),
        "metallic": ", ".join(f"{m:g}" for m in s["metallic"]),
        "trust": _by_roughness(result, ((f"`{x}`", worst[x]) for x in lights), cell),
        "bias": _by_roughness(
            result, ((f"`{x}`", [_bias(result, x, r) for r in s["roughness"]]) for x in lights), _signed
        ),
        "speed": _by_roughness(
            result,
            (
                (f"{shape}, `{light}`", [least_speed_up(result, shape, light, r) for r in s["roughness"]])
                for shape in select.convex(result)
                for light in lights
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
        "truth_height": s["truth_height"],
        "batches": s["batches"],
        "lattice": s["lattice"],
        "size": s["size"],
        "timing_size": s["timing_size"],
        "sun": f"{SUN_ELEVATION:g}",
        "flip": f" (FLIP: {result['flip_reason']})" if result["flip_reason"] else "",
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
        "price_case": f"{select.convex(result)[0]} under `{pareto_light(result)}`, "
        f"metallic {select.picture_metallic(result):g}",
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


def _trust(result: dict[str, Any], light: str, roughness: float) -> Row | None:
    return select.trust(result, light, roughness, "all")


def _bias(result: dict[str, Any], light: str, roughness: float) -> Row:
    """The convex shape and metal of the largest bias, for the finest light."""
    chosen = {"method": "split_sum", "setting": select.best_height(result), "n_dot_v": "all"}
    shapes = select.convex(result)
    rows = where(result["rows"], light=light, roughness=roughness, shape=shapes, **chosen)
    return max(rows, key=lambda row: abs(float(row["bias"])))


def _signed(row: Row) -> str:
    return signed(row["bias"], CLEAR * row["bias_floor"])


def _price(result: dict[str, Any]) -> str:
    """Resolution, levels and options: error and time of one surface."""
    prefilter = {(row["method"], row["height"]): row["ms"] for row in result["prefilter_ms"]}
    found = where(
        result["rows"],
        shape=select.convex(result)[0],
        light=pareto_light(result),
        metallic=select.picture_metallic(result),
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
            for row in where(result["rows"], method=m, setting=select.best_height(result), n_dot_v="all")
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
    """Of the most metallic material: a table for each shape, for the first one at both heights."""
    budgets, order = result["budgets"], select.lights(result)
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
