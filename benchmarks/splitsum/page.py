"""The page in words: what the numbers of a run say, written by the program."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common.errors import CLEAR
from benchmarks.common.lights import SUN_ELEVATION
from benchmarks.common.report import number, percent, prose, signed, table
from benchmarks.common.select import Row, where
from benchmarks.common.view import VIEW_BINS
from benchmarks.splitsum import select
from benchmarks.splitsum.page_budget import budget_section
from benchmarks.splitsum.page_trust import cell, trust_section
from benchmarks.splitsum.plots import TARGET, least_speed_up, pareto_light

ASKED = (0.1, 0.6)
"""Roughness within which the speed-up is asked for."""


def page(result: dict[str, Any], pictures: dict[str, Path], folder: Path) -> str:
    """Markdown; `pictures` by name, linked relative to `folder`."""
    links = {name: os.path.relpath(path, folder).replace(os.sep, "/") for name, path in pictures.items()}
    parts = [
        _opening(result, links),
        _how(result),
        _physics(result),
        trust_section(
            result, _picture(links, "trust", "Typical relative error by light, roughness and view angle")
        ),
        _speed(result, links),
        _price(result, links),
        budget_section(result, _picture(links, "budget", "Error of each approximation alone")),
        _again(result),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _picture(links: dict[str, str], name: str, text: str) -> str:
    return f"![{text}]({links[name]})" if name in links else ""


# ---------------- what, how ----------------


def _opening(result: dict[str, Any], links: dict[str, str]) -> str:
    met, missed = _asked(result)
    ratios = [row["speed_up"] for row in met + missed]
    height = select.best_height(result)
    lights, shapes = len(_varying(result)), len(select.convex(result))
    cases = f"{len(ratios)} cases ({lights} lights × {shapes} shapes"
    opening = f"""On convex objects of roughness {ASKED[0]:g} to {ASKED[1]:g}, with a light of {height}
        rows, the split sum is as good as Mitsuba's path tracer in a time that is
        **{number(float(np.median(ratios)), 2)} times shorter** in the median of {cases} × roughness ×
        metallic); in {len(met)} of them the ratio is {TARGET:g} or more.
        {_where_missed(missed) if missed else ""} A constant light is left out: there the split sum is exact,
        and any ratio says how precise the reference is. Its error does not shrink with time: the path
        tracer's does."""
    return "\n\n".join(
        [
            "# Speed against error: the split sum and Mitsuba's path tracer",
            "*Written by `python -m benchmarks.splitsum`; every number on this page is from one run.*",
            prose(opening),
            _picture(links, "pareto", "Error over time, a panel for each roughness"),
        ]
    )


def _where_missed(missed: list[Row]) -> str:
    counts: dict[tuple[str, str], int] = {}
    for row in missed:
        key = (row["shape"], row["light"])
        counts[key] = counts.get(key, 0) + 1
    places = [
        f"{shape} under `{light}` ({n})" for (shape, light), n in sorted(counts.items(), key=lambda x: -x[1])
    ]
    return f"The other {len(missed)} are: {', '.join(places)}."


def _varying(result: dict[str, Any]) -> list[str]:
    """Lights that are not the same from everywhere, or all if there is no other."""
    return [name for name in select.lights(result) if result["frequencies"][name] > 0] or select.lights(
        result
    )


def _asked(result: dict[str, Any]) -> tuple[list[Row], list[Row]]:
    """Cases of the asked roughness with the finest light that varies: at or above the target, and below."""
    rows = [
        row
        for row in where(result["speed_ups"], height=select.best_height(result), light=_varying(result))
        if ASKED[0] <= row["roughness"] <= ASKED[1]
    ]
    return [r for r in rows if r["speed_up"] >= TARGET], [r for r in rows if r["speed_up"] < TARGET]


def _how(result: dict[str, Any]) -> str:
    s, machine = result["settings"], result["machine"]
    shapes = ", ".join(f"{name} ({count} pixels)" for name, count in result["pixels"].items())
    lights = ", ".join(f"{name} ({number(result['frequencies'][name])})" for name in select.lights(result))
    bins = "; ".join(
        f"{a:g}–{b:g} ({np.degrees(np.arccos(b)):.0f}° to {np.degrees(np.arccos(a)):.0f}°)"
        for a, b in VIEW_BINS
    )
    materials = ", ".join(f"{r:g}" for r in s["roughness"])
    metals = ", ".join(f"{m:g}" for m in s["metallic"])
    flip = f" (FLIP: {result['flip_reason']})" if result["flip_reason"] else ""
    items = [
        f"""**Shapes** {shapes}, all convex, so that no light is blocked or reflected twice; a torus,
        which is not, is in the error budget.""",
        f"**Materials** roughness {materials} × metallic {metals}, albedo (0.9, 0.6, 0.3).",
        f"""**Lights** as maps of {s["truth_height"]} rows with a mean radiance of 1, in brackets the root
        mean square of their gradient over the mean radiance (1/radian): {lights}. `sunsky` is Mitsuba's
        own, its sun {SUN_ELEVATION:g}° above the horizon and baked into about one texel.""",
        """**The same pixels, one point each.** Every sample of every method goes through the centre of
        its pixel: the path tracer looks through a sensor that moves its samples there, and the split sum
        shades what Mitsuba's own rays meet there. Anti-aliasing is on neither side of the comparison.""",
        f"""**Reference** at every pixel the integral of the reflectance and the light, by multiple
        importance sampling of the visible normals and of the light over {s["batches"]} randomly shifted
        lattices of {s["lattice"]} points each: independent batches, whose scatter is the reference's own
        standard error. An error below {CLEAR:g} times what this noise alone would show is printed as "<
        floor".""",
        f"""**Errors** bias: mean signed error over mean radiance. relMSE: mean of (x − ref)² / (ref² +
        ε), ε = (0.01 × mean)²; its root is called the typical relative error here. MAPE and FLIP are in
        the CSV{flip}.""",
        f"**View angle** n·v in {bins}. The patch is a floor seen from 2° to 20° above it.",
        f"""**Times** milliseconds per megapixel of the picture, primary rays included for every method:
        medians of warm runs, all methods in turns, at {s["timing_size"]}² pixels, {machine["threads"]}
        threads of {machine["cpu"]}, Mitsuba {machine["mitsuba"]}, `{machine["variant"]}`. The path tracer
        stops after direct light (`max_depth` 2), which on convex objects is all there is. The light's
        prefilter is paid once a light and listed apart.""",
    ]
    return "\n".join(["## What is measured", "", *(f"- {prose(item)}" for item in items)])


def _physics(result: dict[str, Any]) -> str:
    scores = np.array([row["score"] for row in result["scores"]])
    inside = int((np.abs(scores) < 3).sum())
    largest = max(result["scores"], key=lambda row: abs(row["score"]))
    slopes = [row["path_exponent"] for row in result["speed_ups"] if row["path_exponent"] is not None]
    text = f"""The path tracer with `refgs_bsdf`, at its most samples, against the reference, which shares
        no code with it: the mean error over the pixels in its own standard errors has a standard
        deviation of {scores.std():.2f} over {len(scores)} cases (1 for two estimates of the same
        integral), {inside} of them within 3; the largest, {largest["score"]:+.1f}, is {largest["shape"]}
        under `{largest["light"]}` at roughness {largest["roughness"]:g}. Its relMSE falls as samples to
        the power {np.median(slopes):.2f} (−1 for independent samples). What the split sum differs by is
        therefore approximation."""
    return "## The same physics on both sides\n\n" + prose(text)


# ---------------- what it costs ----------------


def _speed(result: dict[str, Any], links: dict[str, str]) -> str:
    height = select.best_height(result)
    met, missed = _asked(result)
    how = """The time of the path tracer at the samples that reach the split sum's relMSE (a straight line
        in samples through its measured times; relMSE = c/samples through its measured errors), over the
        time of the split sum, both warm and from this run. A `>` marks split sums whose error is lost in
        the reference's noise. Where the path tracer needs less than one sample, it is charged for one: it
        is better and slower there."""
    lines = [
        "## How much faster at equal error",
        prose(how),
        _picture(links, "speedup", "Speed-up at equal error by shape, light and roughness"),
        f"Of the {len(met) + len(missed)} cases at roughness {ASKED[0]:g} to {ASKED[1]:g}, {len(met)} reach "
        f"{TARGET:g}×. " + ("All cases below:" if missed else "There is none below."),
    ]
    if missed:
        rows = [
            [
                f"{row['shape']}, `{row['light']}`",
                f"{row['roughness']:g}",
                f"{row['metallic']:g}",
                percent(row["relmse"] ** 0.5),
                signed(row["bias"]),
                "< 1" if row["path_spp"] < 1 else number(row["path_spp"], 2),
                number(row["speed_up"], 2) + "×",
            ]
            for row in sorted(missed, key=lambda row: float(row["speed_up"]))
        ]
        lines.append(
            table(["case", "roughness", "metallic", "√relMSE", "bias", "path spp", "speed-up"], rows)
        )
    outside = [r for r in result["settings"]["roughness"] if not ASKED[0] <= r <= ASKED[1]]
    if outside:
        rows = [
            [
                f"{shape}, `{light}`",
                *(number(least_speed_up(result, shape, light, r)["speed_up"], 2) + "×" for r in outside),
            ]
            for shape in select.convex(result)
            for light in select.lights(result)
        ]
        lines += [
            f"Outside that range, the least over metals ({height} rows):",
            table(["case", *(f"r = {r:g}" for r in outside)], rows),
        ]
    return "\n\n".join(lines)


def _price(result: dict[str, Any], links: dict[str, str]) -> str:
    """Resolution, levels and knobs: error and price."""
    shape, light, metallic = select.convex(result)[0], pareto_light(result), select.picture_metallic(result)
    prefilter = {(row["method"], row["height"]): row["ms"] for row in result["prefilter_ms"]}
    roughness = list(result["settings"]["roughness"])
    methods: dict[tuple[str, int], None] = {}
    for row in result["rows"]:
        if row["method"].startswith("split_sum"):
            methods[row["method"], row["setting"]] = None
    rows = []
    for method, height in methods:
        cells = where(
            result["rows"],
            shape=shape,
            light=light,
            metallic=metallic,
            method=method,
            setting=height,
            n_dot_v="all",
        )
        by = {row["roughness"]: row for row in cells}
        name = method.removeprefix("split_sum").strip("_").replace("_", " ") or "shipped"
        cost = prefilter.get((method, height), prefilter.get(("split_sum", height)))
        rows.append(
            [
                f"{name}, {height} rows",
                *(cell(by[r]) for r in roughness),
                number(cells[0]["ms_per_mpx"]),
                number(cost) if cost else "–",
            ]
        )
    head = ["split sum", *(f"r = {r:g}" for r in roughness), "ms/Mpx", "prefilter, ms"]
    return "\n\n".join(
        [
            "## What resolution, levels and knobs buy",
            prose(
                f"""Typical relative error of {shape} under `{light}`, metallic {metallic:g}. A light of
                more rows costs no more to look up, only to prefilter (once a light). `few` and `many
                levels` replace the seven filtered levels by three and fourteen; `dominant` looks the
                light up along the lobe's dominant direction; `multiscatter` adds light that the
                reference, a single-scattering model, does not have: its difference is the energy that it
                restores, not an error."""
            ),
            table(head, rows),
            _knob(result),
            _picture(links, "lights", "Error over time, a panel for each light"),
        ]
    )


def _knob(result: dict[str, Any]) -> str:
    """In how many cases the dominant direction pays."""
    height = select.best_height(result)
    keys = ("shape", "light", "roughness", "metallic")
    plain, turned = (
        {
            tuple(row[k] for k in keys): row
            for row in where(result["rows"], method=m, setting=height, n_dot_v="all")
        }
        for m in ("split_sum", "split_sum_dominant")
    )
    if not turned:
        return ""
    factors: dict[float, list[float]] = {}
    for key, row in turned.items():
        if not row["below_floor"] and not plain[key]["below_floor"]:
            factors.setdefault(row["roughness"], []).append(row["relmse"] / plain[key]["relmse"])
    if not factors:
        return ""
    said = [
        f"{np.median(ratios):.2f} at {r:g} (lower in {sum(x < 1 for x in ratios)} of {len(ratios)})"
        for r, ratios in sorted(factors.items())
    ]
    times = [turned[key]["ms_per_mpx"] / plain[key]["ms_per_mpx"] for key in turned]
    return (
        "The dominant direction multiplies relMSE, in the median over shapes, lights and metals, by "
        f"{', '.join(said)}, by roughness; it takes {np.median(times):.2f} times as long."
    )


def _again(result: dict[str, Any]) -> str:
    text = f"""`python -m benchmarks.splitsum` writes this page and its plots, and `splitsum.csv` and
        `splitsum.json` with all rows behind them to `runs/`; this run took {result["seconds"] / 60:.1f}
        minutes. `--envmap FILE` adds your light, `--shape` and `--light` choose among the built-in ones,
        `--small` takes less than a minute, `--full` more pixels and samples."""
    return "## Again\n\n" + prose(text)
