"""What a run fills into the page: its tables and a few numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.budget import above_noise, budget_table, interactions
from benchmarks.common.report import number, signed, table
from benchmarks.common.select import Row, where
from benchmarks.visibility.tradeoff import MIRROR, TIMES

WHAT = dict(zip(TIMES, ("shading the mesh", "the product's frame"), strict=True))
DEPTHS = {"direct": "depth 2", "full": "full depth"}


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    s, budgets = result["settings"], above_noise(result["budgets"])
    mirror = where(result["rows"], depth="full", method=MIRROR)
    none = where(result["rows"], depth="full", rays=0)
    return {
        "scenes": table(
            ["scene", "pixels", "triangles", "surfels"],
            [[name, *(f"{fact[k]:,}" for k in fact)] for name, fact in result["scenes"].items()],
        ),
        "summary": table(
            ["by the time of", "smaller in", "median ratio", "least", "most"],
            [[WHAT[key], *_summary(where(result["tradeoffs"], time=key))] for key in TIMES],
        ),
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
        "light_height": s["light_height"],
        "spp": f"{s['spp'] * s['batches']:,}",
        "batches": s["batches"],
        "timing_size": s["timing_size"],
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
    head = ["case", "time of", "setting", "relMSE, mirror ray alone", "with harmonics", "with the setting"]
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
    """What is left with the most rays where the setting within the budget is worse than harmonics."""
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
        tables.append(f"**{name[0].upper()}{name[1:]}**\n\n{budget_table('case', cases)}")
    return "\n\n".join(tables)
