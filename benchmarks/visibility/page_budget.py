"""The section of the page on the error budgets."""

from __future__ import annotations

from typing import Any

from benchmarks.common.page_budget import adding_up, budget_table, interactions, largest
from benchmarks.common.report import prose
from benchmarks.common.select import where
from benchmarks.visibility.harmonics import DEGREE

HARMONICS = f"""With V the visibility of the mirror direction, S the split sum's reflectance and I the
    indirect channel, the paper's picture is V × prefiltered light × S + (1 − V) × I × S (the rule `mirror
    ray` of the other tables has no I). I is the best that such a channel can be: at every pixel's point
    its own spherical harmonics of degree {DEGREE}, fitted by least squares to the radiance that Mitsuba's
    `path` finds there, at full depth, in all blocked directions of the upper hemisphere. One
    approximation after the other is then replaced by its exact counterpart: the visibility of the mirror
    ray by the exact share of the lobe that is free; the harmonics along the mirror direction by their
    mean over the blocked directions of the lobe; the harmonics by the true light in those directions; the
    split sum of the free light by its integral as if nothing stood in the way; and the product of that
    integral with the visibility by the integral of the product. What stands at the end is the path
    tracer's picture at full depth, its direct light by quadrature. In this order every step is defined at
    every pixel: harmonics have a value where the mirror ray is free, true indirect light along it has
    none. Harmonics fitted to photographs differ from these: they can take up errors of other parts, and
    are only fitted where the views' mirror directions are blocked."""
TRACED = """The same from the picture with one mirror ray and traced light (`traced_bounces`), by its
    number of bounces: first the mirror ray gives way to {rays} rays of the lobe, for visibility and for
    traced light; then the shading of what they hit, split sums and mirror rays, to the path tracer's
    light of as many more reflections; then that to light of any number of reflections; the last two as
    above."""
FORM = """A percentage is a part's projection on the whole error (a negative one cancels others); in
    brackets its relMSE alone; the last column is what the sum of those misses."""


def budget_section(result: dict[str, Any]) -> str:
    """Markdown of the budgets, "" where there are none."""
    budgets = result["budgets"]
    if not budgets:
        return ""
    rays = max(*result["settings"]["rays"], *result["settings"]["more_rays"])
    names = dict.fromkeys(row["indirect"] for row in budgets)
    lines = ["## Where the error comes from", adding_up(budgets), prose(FORM)]
    lines += ["### Mirror ray and spherical harmonics", prose(HARMONICS)]
    for k, name in enumerate(names):
        if k == 1:
            lines += ["### Mirror ray and traced light", prose(TRACED.format(rays=rays))]
        found = where(budgets, indirect=name)
        said = "; ".join(
            f"at roughness {r:g} {largest(where(found, roughness=r))}"
            for r in dict.fromkeys(row["roughness"] for row in found)
        )
        cases = [(f"{row['scene']}, r = {row['roughness']:g}", row) for row in found]
        lines += [f"**{name[0].upper()}{name[1:]}.** Largest share: {said}.", budget_table("case", cases)]
    return "\n\n".join(line for line in (*lines, interactions(budgets)) if line)
