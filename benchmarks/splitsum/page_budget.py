"""The section of the page on the error budgets."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.common.report import number, percent, prose, table
from benchmarks.splitsum import decompose, select
from benchmarks.splitsum.select import Row, where

BUDGET_SHOWN = (0.1, 0.3, 0.8)
"""Roughness of the tables, or the nearest ones measured."""


def budget_section(result: dict[str, Any], picture: str) -> str:
    """Markdown of the budgets, "" where there are none."""
    budgets = result["budgets"]
    if not budgets:
        return ""
    metallic = max(row["metallic"] for row in budgets)
    how = """One approximation after the other is replaced by its exact counterpart, from the picture that
        ships to the exact integral: the table by float64 quadrature, the light's resolution by the whole
        map, the mix of levels and their grids by the exact lobe average at this roughness, the lobe with
        N = V = R by the reflectance's own lobe without Fresnel's term, and the one average that F0·A and
        B share by one each. The signed differences add up to the whole error at every pixel. A percentage
        is each one's projection on the whole error (they sum to 100 %; a negative one cancels others); in
        brackets its relMSE alone. Those squares add up only where the parts are uncorrelated: the last
        column says what is left, twice the covariances, and which two parts it is most due to."""
    lines = ["## Where the error comes from", prose(how), picture]
    roughness = sorted({min(result["settings"]["roughness"], key=lambda r: abs(r - x)) for x in BUDGET_SHOWN})
    lines.append("The tables show a part of what is in the JSON: other roughness, and metallic 0, are there.")
    for shape in dict.fromkeys(row["shape"] for row in budgets):
        heights = sorted({row["height"] for row in budgets})
        for height in heights if shape == budgets[0]["shape"] else heights[-1:]:
            cases = where(budgets, shape=shape, metallic=metallic, height=height, roughness=roughness)
            lines += [
                f"**{shape}, metallic {metallic:g}, {height} rows of light**",
                _budget_table(result, cases),
            ]
    lines += [_adding_up(budgets), *_surfels(result)]
    return "\n\n".join(lines)


def _surfels(result: dict[str, Any]) -> list[str]:
    """The budget of a sphere of surfels."""
    budgets = result["surfel_budgets"]
    if not budgets:
        return []
    order = select.lights(result)
    cases = sorted(budgets, key=lambda row: order.index(row["light"]))
    names = [part["name"] for part in cases[0]["parts"]]
    rows = [[f"`{case['light']}`", *_budget_cells(case, names)] for case in cases]
    covered = min(case["covered"] for case in cases)
    text = f"""The same for the deferred picture of a sphere that {cases[0]["surfels"]:,} surfels cover
        ({percent(covered)} of its pixels), {result["settings"]["size"]}² pixels, with exact positions and
        normals and two materials in bands (a metal of roughness 0.2, a dielectric of 0.6). First the
        materials are shaded one by one before they are blended, then the blended normals give way to the
        sphere's, then the surfels' coverage and the edges of their bands to the sphere's own, then the
        split sum to the exact integral. Fitted surfels are less even than these: this is what the
        representation costs when the fit is perfect."""
    return [
        "### Surfels instead of a mesh",
        prose(text),
        table(["light", *names, "total", "sum", "interaction"], rows),
    ]


def _budget_cells(case: Row, names: list[str]) -> list[str]:
    """Parts, total, sum and interaction of a budget."""
    if case["total"] < case["floor"]:
        return [*["–"] * len(names), f"< {number(case['floor'], 2)}", "–", "noise"]
    parts = [f"{100 * part['share']:.0f} % ({number(part['relmse'], 2)})" for part in case["parts"]]
    left = f"{100 * case['interaction'] / case['total']:+.0f} %"
    if not case["adds_up"]:
        left += f": {case['pair'][0]} and {case['pair'][1]}, ρ = {case['correlation']:+.2f}"
    return [*parts, number(case["total"], 2), number(case["sum"], 2), left]


def _budget_table(result: dict[str, Any], cases: list[Row]) -> str:
    names = [part["name"] for part in cases[0]["parts"]]
    order = select.lights(result)
    rows = [
        [f"`{case['light']}`, r = {case['roughness']:g}", *_budget_cells(case, names)]
        for case in sorted(cases, key=lambda row: (order.index(row["light"]), row["roughness"]))
    ]
    return table(["case", *names, "total", "sum", "interaction"], rows)


def _adding_up(budgets: list[Row]) -> str:
    clear = [row for row in budgets if row["total"] >= row["floor"]]
    met = sum(row["adds_up"] for row in clear)
    pairs: dict[tuple[str, str], list[float]] = {}
    for row in clear:
        if not row["adds_up"]:
            pairs.setdefault(tuple(row["pair"]), []).append(row["correlation"])
    text = f"Of {len(clear)} budgets above the noise, {met} add up to a fifth by their squares alone."
    if pairs:
        said = [
            f"{a} with {b} in {len(values)} (median ρ {np.median(values):+.2f}): {_reason(a, b)}"
            for (a, b), values in sorted(pairs.items(), key=lambda item: -len(item[1]))
        ]
        text += " In the others the interaction is due to\n\n" + "\n".join(f"- {item};" for item in said)
        text = text[:-1] + "."
    return text


REASONS = {
    frozenset(
        (decompose.SHADOW, decompose.BOUNCES)
    ): "what blocks the light also reflects some, so the two errors "
    "have opposite signs at the same pixels, and leaving both out is better than leaving out one",
    frozenset(
        (decompose.RESOLUTION, decompose.LOBE)
    ): "a coarse map and a lobe that is too wide at grazing angles blur the same edges",
    frozenset(
        (decompose.LEVELS, decompose.LOBE)
    ): "both are errors of the lobe's width around the same features of the light",
    frozenset((decompose.RESOLUTION, decompose.LEVELS)): "both blur the same features of the light",
    frozenset(
        (decompose.LOBE, decompose.SCHLICK)
    ): "Fresnel's term favours the grazing side of the very lobe whose shape is replaced just before",
    frozenset(
        (decompose.LOBE, decompose.SHADOW)
    ): "light from below the mirror direction is both what the lobe gets wrong and what the shape blocks",
}


def _reason(a: str, b: str) -> str:
    return REASONS.get(frozenset((a, b)), "their patterns on the object are alike")
