"""The section of the page on the error budgets."""

from __future__ import annotations

from typing import Any

from benchmarks.common.page_budget import adding_up, budget_table, interactions
from benchmarks.common.report import percent, prose
from benchmarks.common.select import Row, where
from benchmarks.splitsum import decompose, select

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
        is each one's projection on the whole error (a negative one cancels others); in brackets its relMSE
        alone. The last column says what the sum of those misses, twice the products of the parts, and which
        two parts it is most due to. How a mirror ray and spherical harmonics stand for visibility and
        indirect light is taken apart by `python -m benchmarks.visibility`, in concave scenes."""
    groups = decompose.GROUPS
    lines = ["## Where the error comes from", adding_up(budgets, groups), prose(how), picture]
    roughness = sorted({min(result["settings"]["roughness"], key=lambda r: abs(r - x)) for x in BUDGET_SHOWN})
    lines.append("The tables show a part of what is in the JSON: other roughness, and metallic 0, are there.")
    for shape in dict.fromkeys(row["shape"] for row in budgets):
        heights = sorted({row["height"] for row in budgets})
        for height in heights if shape == budgets[0]["shape"] else heights[-1:]:
            cases = where(budgets, shape=shape, metallic=metallic, height=height, roughness=roughness)
            lines += [
                f"**{shape}, metallic {metallic:g}, {height} rows of light**",
                budget_table("case", _labelled(result, cases)),
            ]
    return "\n\n".join([*lines, interactions(budgets), *_surfels(result)])


def _labelled(result: dict[str, Any], cases: list[Row]) -> list[tuple[str, Row]]:
    order = select.lights(result)
    ordered = sorted(cases, key=lambda row: (order.index(row["light"]), row["roughness"]))
    return [(f"`{row['light']}`, r = {row['roughness']:g}", row) for row in ordered]


def _surfels(result: dict[str, Any]) -> list[str]:
    """The budget of a sphere of surfels."""
    budgets = result["surfel_budgets"]
    if not budgets:
        return []
    order = select.lights(result)
    cases = sorted(budgets, key=lambda row: order.index(row["light"]))
    covered = min(case["covered"] for case in cases)
    text = f"""The same for the deferred picture of a sphere that {cases[0]["surfels"]:,} surfels cover
        ({percent(covered)} of its pixels), {result["settings"]["size"]}² pixels, with exact positions and
        normals and two materials in bands (a metal of roughness 0.2, a dielectric of 0.6). First the
        materials are shaded one by one before they are blended, then the blended normals give way to the
        sphere's, then the surfels' coverage and the edges of their bands to the sphere's own, then the
        split sum to the exact integral. TrainedScene surfels are less even than these: this is what the
        representation costs when the fit is perfect."""
    return [
        "### Surfels instead of a mesh",
        prose(text),
        adding_up(cases),
        budget_table("light", [(f"`{case['light']}`", case) for case in cases]),
    ]
