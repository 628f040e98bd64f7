"""The page in words: what the numbers of a run say, written by the program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.report import number, prose, signed, table
from benchmarks.common.select import where
from benchmarks.visibility.page_budget import budget_section
from benchmarks.visibility.payoff import BUDGET, MIRROR
from benchmarks.visibility.settings import ALBEDO

WHAT = {"ms": "shading the mesh", "frame_ms": "the product's frame"}


def page(result: dict[str, Any], picture: Path, folder: Path) -> str:
    """Markdown; the picture is linked relative to `folder`."""
    link = os.path.relpath(picture, folder).replace(os.sep, "/")
    parts = [
        _opening(result, link),
        _how(result),
        _gains(result),
        budget_section(result),
        _errors(result),
        _curve(result),
        _again(result),
    ]
    return "\n\n".join(parts) + "\n"


def _opening(result: dict[str, Any], link: str) -> str:
    said = []
    for key, what in WHAT.items():
        found = where(result["payoffs"], time=key)
        better = [row for row in found if row["gain"] > 1]
        low, high = (pick(found, key=lambda row: float(row["gain"])) for pick in (min, max))
        said.append(
            f"""By the time of {what}, it is smaller in {len(better)} of {len(found)} cases; the ratio is
            {number(_median(found), 2)}× in the median, at the least {number(low["gain"], 2)}× ({_case(low)}),
            at the most {number(high["gain"], 2)}× ({_case(high)})."""
        )
    text = f"""How much smaller is the squared error against the path tracer at full depth with rays of the
        lobe and traced light than with the paper's rule, one mirror ray and the best indirect light that
        spherical harmonics can be, for at most {BUDGET:g} times the time of the mirror ray? {" ".join(said)}
        The setting of each scene is chosen on the other scenes."""
    return "\n\n".join(
        [
            "# Visibility and indirect light in concave scenes",
            "*Written by `python -m benchmarks.visibility`; every number on this page is from one run.*",
            prose(text),
            f"![Error over time, and convergence with the number of rays]({link})",
            prose(
                """Above: error over time, a number beside a mark is its rays of the lobe, the grey line the
                mirror ray alone. Below: how rays of the lobe approach the traced answer (solid: mean
                visibility against exact visibility, dotted that one's own noise; dashed: the picture with
                traced light against the same with very many rays)."""
            ),
        ]
    )


def _median(rows: list[dict[str, Any]]) -> float:
    return float(np.median([row["gain"] for row in rows]))


def _case(row: dict[str, Any]) -> str:
    return f"{row['scene']}, roughness {row['roughness']:g}"


def _how(result: dict[str, Any]) -> str:
    s, machine = result["settings"], result["machine"]
    scenes = ", ".join(
        f"{name} ({fact['pixels']:,} pixels, {fact['triangles']:,} triangles, {fact['surfels']:,} surfels)"
        for name, fact in result["scenes"].items()
    )
    spp = s["spp"] * s["batches"]
    items = [
        f"""**Scenes** {scenes}. `bowl` is a torus in a bowl that reaches to 60° from its lowest point,
        `deep_bowl` one in half a sphere, `plates` are two plates that face each other at 60°. All is metal of
        albedo {ALBEDO}: the picture is its specular part. The light is `scenes/lights/studio.exr` with
        {s["light_height"]} rows on both sides, scaled to a mean of 1.""",
        """**The same pixels** one ray through each pixel's centre on both sides. Points and normals to shade
        are Mitsuba's own, the occluder is the same mesh, and the surfels that traced light takes its material
        from sit on its vertices: only visibility, indirect light, and the split sum's own error differ.""",
        f"""**Reference** Mitsuba's `path` with `refgs_bsdf`, {spp:,} samples a pixel in {s["batches"]}
        batches, whose scatter is its standard error: at `max_depth` 2 (light after one reflection), 3
        and 12, the full depth.""",
        """**Errors** relMSE: mean of (x − ref)² / (ref² + ε), ε = (0.01 × mean)²; in brackets the bias, mean
        signed error over mean radiance. A `<` marks what the reference's noise may be all of. A
        few pixels that see next to no light weigh much at depth 2.""",
        f"""**Times** medians of warm runs, all rules in turns, roughness 0.3, {s["timing_size"]}² pixels,
        {machine["threads"]} threads of {machine["cpu"]}, Mitsuba {machine["mitsuba"]},
        `{machine["variant"]}`. *Shading*: primary rays, visibility and shading on the mesh. *Frame*: what
        `mi_refgs.render` takes for the surfels on its vertices, splatting included.""",
    ]
    return "\n".join(["## What is measured", "", *(f"- {prose(item)}" for item in items)])


def _gains(result: dict[str, Any]) -> str:
    rows = []
    for row in result["payoffs"]:
        rows.append(
            [
                _case(row),
                WHAT[row["time"]],
                row["method"],
                number(row["mirror_relmse"]),
                number(row["paper_relmse"]),
                number(row["relmse"]),
                f"{number(row['gain'])}×",
                f"{number(row['best_gain'])}×",
                f"{number(row['price'], 2)}×",
            ]
        )
    head = [
        "case",
        "time of",
        "setting",
        "relMSE, mirror ray alone",
        "with harmonics",
        "with the setting",
        "gain",
        "in hindsight",
        "price",
    ]
    text = """*With harmonics* is the paper's rule: the mirror ray, and behind what blocks it spherical
        harmonics fitted to the path tracer's own light, the best that the indirect channel can be. *Gain* is
        its relMSE over that of the setting, *in hindsight* over that of the best setting for this very
        picture, *price* the setting's time over that of the mirror ray alone."""
    lines = ["## What the options buy", prose(text), table(head, rows), _blocked(result)]
    short = [row for row in where(result["payoffs"], time="frame_ms") if row["gain"] < 1]
    if short:
        names = "; ".join(f"{_case(row)} ({number(row['gain'])}×)" for row in short)
        lines.append(
            prose(
                f"""Worse than the best harmonics by the time of the frame: {names}. The next table says what
                is left with the most rays, whatever their price: with one bounce against the path tracer
                stopped after one more reflection (`max_depth` 3), which is all that one bounce stands for,
                and with the most bounces at full depth; the budgets below take the error with one mirror ray
                apart."""
            )
        )
        most = max(result["settings"]["bounces"])
        head = ["case", "rays", "1 bounce at depth 3: relMSE (bias)", f"{most} bounces at full depth"]
        lines.append(table(head, [_limit(result, row) for row in short]))
    return "\n\n".join(lines)


def _blocked(result: dict[str, Any]) -> str:
    """Where blocking light without giving any back is worse than not blocking it."""
    rays = max(result["settings"]["rays"])

    def further(depth: str, method: str) -> list[dict[str, Any]]:
        rows = where(result["rows"], depth=depth)
        pairs = zip(where(rows, method=method), where(rows, rays=0), strict=True)
        return [row for row, bare in pairs if row["relmse"] > bare["relmse"]]

    worse = [_case(row) for row in further("full", MIRROR)]
    if not worse:
        return "The mirror ray alone is nearer to the full picture than no occlusion at all in every case."
    direct, many = (
        sum(_case(row) in worse for row in further(*key))
        for key in (("direct", MIRROR), ("full", f"{rays} rays"))
    )
    cases = len(where(result["rows"], depth="full", method=MIRROR))
    return prose(
        f"""The mirror ray alone is further from the full picture than no occlusion at all in {len(worse)} of
        {cases} cases: {", ".join(worse)}. Without reflected light in the reference (depth 2) it is so in
        {direct} of them: what blocks light also reflects some. With {rays} rays of the lobe, and no traced
        light either, it is so in {many}."""
    )


def _limit(result: dict[str, Any], case: dict[str, Any]) -> list[str]:
    rows = where(result["rows"], scene=case["scene"], roughness=case["roughness"], dominant=False)
    rays = max(int(row["rays"]) for row in rows if row["bounces"])
    ends = (("bounce", 1), ("full", max(result["settings"]["bounces"])))
    return [
        _case(case),
        str(rays),
        *(_cell(where(rows, rays=rays, depth=depth, bounces=bounces)[0]) for depth, bounces in ends),
    ]


def _errors(result: dict[str, Any]) -> str:
    lines = ["## Every rule"]
    depths = {
        "direct": (
            "Against the path tracer at depth 2, which has no light from other surfaces either",
            {"bounces": 0},
        ),
        "full": ("Against the path tracer at full depth", {}),
    }
    roughness = list(result["settings"]["roughness"])
    for scene in result["scenes"]:
        lines.append(f"### {scene}")
        for depth, (caption, chosen) in depths.items():
            found = where(result["rows"], scene=scene, depth=depth, **chosen)
            rows = []
            for method in dict.fromkeys(row["method"] for row in found):
                by = {row["roughness"]: row for row in where(found, method=method)}
                first = by[roughness[0]]
                if first["ms"] is None:
                    continue
                cells = [_cell(by[r]) for r in roughness]
                rows.append([method, *cells, number(first["ms"]), number(first["frame_ms"])])
            head = ["rule", *(f"r = {r:g}" for r in roughness), "shading, ms", "frame, ms"]
            lines += [f"{caption}: relMSE (bias).", table(head, rows)]
    return "\n\n".join(lines)


def _cell(row: dict[str, Any]) -> str:
    small = "< " if row["below_floor"] else ""
    return f"{small}{number(row['relmse'], 2)} ({signed(row['bias'])})"


def _curve(result: dict[str, Any]) -> str:
    rows = []
    counts = list(dict.fromkeys(row["rays"] for row in result["curve"]))
    for case in dict.fromkeys((row["scene"], row["roughness"]) for row in result["curve"]):
        found = {row["rays"]: row for row in where(result["curve"], scene=case[0], roughness=case[1])}
        cells = [number(found[k]["visibility_rms"], 2) for k in counts]
        rows.append([f"{case[0]}, r = {case[1]:g}", *cells, number(found[counts[0]]["visibility_floor"], 2)])
    text = """Root mean square difference of the mean visibility over k rays from the exact one: the share of
        the reflectance, integrated by code of the benchmark's own, that Mitsuba's rays find free. The last
        column is that integral's own standard error."""
    head = ["case", *(f"k = {k}" for k in counts), "noise"]
    return "\n\n".join(["## Many rays are the traced answer", prose(text), table(head, rows)])


def _again(result: dict[str, Any]) -> str:
    files = "".join(f" with `--mesh {Path(name).name}`" for name in result["settings"]["meshes"])
    text = f"""`python -m benchmarks.visibility` writes this page and its plot, and `visibility.csv` and
        `visibility.json` with all rows behind them to `runs/`; this run took {result["seconds"] / 60:.1f}
        minutes{files}. `--mesh FILE` (repeatable) adds a closed mesh of yours, `--small` is a coarse
        instance for a quick look."""
    return "## Again\n\n" + prose(text)
