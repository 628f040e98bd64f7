"""Plots of the pages, docs/images/NAME.png, from the data files: python -m benchmarks.plots [NAME ...]"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures
from benchmarks.common.build import RESULTS, read_result
from benchmarks.common.errors import CLEAR
from benchmarks.common.report import Row, plain_parser, where
from benchmarks.common.view import ROOT
from benchmarks.splatting.__main__ import FLOPS
from benchmarks.stability.measure import GRADIENT_LIMIT, IMAGE_LIMIT
from benchmarks.tables import worst_gradient
from mi_refgs.evaluation.scores import PIXEL_CLASSES
from mi_refgs.io.files import is_file

Result = dict[str, Any]
COLOURS = ("#bdbdbd", "#e6a04b", "#c0392b", "#4292c6", "#9ecae1", "#eeeeee")  # of PIXEL_CLASSES
BLUES = ("#9ecae1", "#4292c6", "#2171b5", "#08306b")


def splatting_time(result: Result, path: Path) -> Path:
    """Time over contributing pairs, ours, volprim's and the lower bound."""
    kinds = {"forward": "forward", "both": "forward + backward"}
    figure, axes = figures.grid(
        list(kinds.values()), 2, 4.6, 3.8, "contributing surfel-pixel pairs", "milliseconds"
    )
    counts = sorted({row["surfels"] for row in result["rows"]})
    for ax, kind in zip(axes, kinds, strict=True):
        for k, count in enumerate(counts):
            rows = where(result["rows"], surfels=count)
            x, y = ([row[key] for row in rows] for key in ("contributing", f"{kind}_ms"))
            label = f"ours, {count:,} surfels"
            figures.series(ax, x, y, "os^D"[k % 4], label, color=BLUES[k % 4])
        pairs = [row["contributing"] for row in result["rows"]]
        theirs = [row[f"volprim_{kind}_ms"] for row in result["rows"]]
        figures.series(ax, pairs, theirs, "x", "volprim_rf_basic", color="#c0392b")
        line = np.geomspace(min(pairs), max(pairs), 50)
        bound = 1e-6 * line * FLOPS[kind] / result["gflops"]
        figures.series(ax, line.tolist(), bound.tolist(), "k-", "lower bound: peak arithmetic")
    return figures.save(figure, axes, path, 3)


def splitsum_pareto(result: Result, path: Path) -> Path:
    """Error over time of the split sum and the path tracer, one panel per roughness."""
    settings, lights = result["settings"], list(result["frequencies"])
    light = "studio" if "studio" in lights else lights[-1]
    metallic = settings["metallic"][len(settings["metallic"]) // 2]
    titles = [f"roughness {r:g}" for r in settings["roughness"]]
    figure, axes = figures.grid(titles, 4, 2.9, 2.6, "ms per megapixel", "relMSE")
    for ax, roughness in zip(axes, settings["roughness"], strict=True):
        case = {"shape": settings["shapes"][0], "light": light, "metallic": metallic, "n_dot_v": "all"}
        cases = where(result["rows"], roughness=roughness, **case)
        for method, style, label in (
            ("path", "o-", "Mitsuba path, 1 to 64 samples per pixel"),
            ("split_sum", "s", "split sum, 16 to 256 rows of light"),
            ("split_sum_dominant", "D", "dominant direction"),
        ):
            rows = where(cases, method=method)
            error = [max(row["relmse"], CLEAR * row["relmse_floor"]) for row in rows]
            figures.series(ax, [row["ms_per_mpx"] for row in rows], error, style, label)
    figure.suptitle(f"{case['shape']}, light: {light}, metallic {metallic:g}", fontsize=10)
    return figures.save(figure, axes, path)


def visibility_time(result: Result, path: Path) -> Path:
    """Error over the time of a frame by bounces, one panel per scene, at a middling roughness."""
    values = result["settings"]["roughness"]
    roughness = values[len(values) // 2]
    figure, axes = figures.grid(
        list(result["scenes"]), 4, 3.2, 2.9, "ms per frame", f"relMSE, roughness {roughness:g}"
    )
    for ax, scene in zip(axes, result["scenes"], strict=True):
        rows = where(result["rows"], scene=scene, roughness=roughness)
        for k, bounces in enumerate((0, *result["settings"]["bounces"])):
            found = [
                row for row in where(rows, bounces=bounces, dominant=False) if row["frame_ms"] and row["rays"]
            ]
            x, y = ([row[key] for row in found] for key in ("frame_ms", "relmse"))
            label = f"{bounces} bounce{'s' * (bounces > 1)}" if bounces else "rays only"
            figures.series(ax, x, y, "o-", label, color=("#c77b30", *BLUES)[k % 5])
        none = where(rows, rays=0)[0]
        figures.series(ax, [none["frame_ms"]], [none["relmse"]], "kx", "no occlusion")
        figures.plain_times(ax)
    return figures.save(figure, axes, path, 6)


def stability_cases(result: Result, path: Path) -> Path:
    """Image and gradient errors of the hard cases in ascending order, with their limits."""
    measures: dict[str, tuple[Callable[[Row], float], float]] = {
        "image": (lambda row: float(row["image"]), IMAGE_LIMIT),
        "gradient": (worst_gradient, GRADIENT_LIMIT),
    }
    figure, axes = figures.grid(list(measures), 2, 4.2, 2.8, "hard cases", "relative error")
    for ax, (error, limit) in zip(axes, measures.values(), strict=True):
        for verdict, style in (("within", "o"), ("ill", "x")):
            rows = sorted(result["rows"], key=error)
            found = [(i, error(row)) for i, row in enumerate(rows) if row["verdict"].startswith(verdict)]
            if found:
                label = "within limits" if verdict == "within" else "ill-conditioned"
                ax.plot(*zip(*found, strict=True), style, markersize=3, label=label)
        ax.axhline(limit, color="k", lw=0.8, ls=":", label="limit")
        ax.set(yscale="log", ylim=(1e-9, 10))
    return figures.save(figure, axes, path)


def endtoend_frames(result: Result, path: Path) -> Path:
    """Error over time of whole frames, one panel per scene."""
    scenes = list(dict.fromkeys(row["scene"] for row in result["rows"]))
    label = "error against the converged path tracer"
    figure, axes = figures.grid(scenes, 3, 3.4, 3.0, "ms per frame", label)
    for ax, scene in zip(axes, scenes, strict=True):
        rows = where(result["rows"], scene=scene)
        for k, spp in enumerate(result["settings"]["refgs_spp"]):
            found = where(rows, renderer="refgs", spp=spp)
            x, y = ([row[key] for row in found] for key in ("ms", "error"))
            figures.series(
                ax, x, y, "s-", f"refgs, {spp} sample{'s' * (spp > 1)} per pixel", color=BLUES[1 + 2 * k]
            )
        found = where(rows, renderer="path")
        x, y = ([row[key] for row in found] for key in ("ms", "error"))
        figures.series(ax, x, y, "o-", "Mitsuba path", color="#c0392b")
        shading = where(rows, renderer="refgs")[0]["shading"]
        ax.axhline(shading, color="k", lw=0.8, ls=":", label="refgs, shading alone")
        figures.plain_times(ax)
    return figures.save(figure, axes, path)


def oracle_parts(result: Result, path: Path) -> Path:
    """Squared error by class of pixels where parts of a fit are true, one panel per scene."""
    most = max(row["samples"] for row in result["rows"])
    scenes = list(dict.fromkeys(row["scene"] for row in result["rows"]))
    figure, axes = figures.grid(
        scenes, 2, 5.2, 3.8, f"mean squared error, 1e-5, {most} samples per pixel", ""
    )
    for ax, scene in zip(axes, scenes, strict=True):
        rows = where(result["rows"], scene=scene, samples=most)
        names, left = [row["case"] for row in rows], np.zeros(len(rows))
        for (key, label), colour in zip(PIXEL_CLASSES.items(), COLOURS, strict=True):
            if any(width := [row[key] for row in rows]):
                ax.barh(names, width, left=left, label=label, color=colour)
                left += width
        for row, end in zip(rows, left, strict=True):
            ax.text(end, row["case"], f" {row['psnr']:.1f} dB", fontsize=7, va="center")
        ax.set_xlim(right=1.15 * left.max())
    axes[0].invert_yaxis()  # shared
    return figures.save(figure, axes, path, 3)


DRAWN = (splatting_time, splitsum_pareto, visibility_time, stability_cases, endtoend_frames, oracle_parts)
PLOTS: dict[str, Callable[[Result, Path], Path]] = {function.__name__: function for function in DRAWN}
"""Name of an image → what draws it; its first word is the data file."""


def draw(name: str, results: Path, folder: Path) -> Path | None:
    """Draw a plot into a folder; returns its path, None if its data file is not there."""
    data = results / f"{name.partition('_')[0]}.json"
    return PLOTS[name](read_result(data), folder / f"{name}.png") if is_file(data) else None


def main(arguments: list[str] | None = None) -> int:
    """Draw the named plots, all without names."""
    parser = plain_parser("plots", __doc__)
    parser.add_argument("name", nargs="*", help="some of the plots; all without")
    for name in parser.parse_args(arguments).name or PLOTS:
        print(draw(name, RESULTS, ROOT / "docs" / "images"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
