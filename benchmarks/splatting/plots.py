"""The plots: time over contributing pairs with the machine's limit, and the stages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures
from benchmarks.splatting.limits import FLOPS
from benchmarks.splatting.measure import PHASES
from benchmarks.splatting.targets import cpp, label

SHADES = ("#9ecae1", "#4292c6", "#2171b5", "#08306b")
MARKERS = ("o", "s", "^", "D")
PANELS = {"forward": "forward", "both": "forward + backward"}
BARS = {
    "project": "#bbbbbb",
    "bin": "#f2c14e",
    "sort": "#c77b30",
    "blend": "#4292c6",
    "adjoint": "#08306b",
    "project backward": "#777777",
}
"""Colours of stages; `scatter` is part of the adjoint, and hatched there."""
MOST_BARS = 12


def plot(result: dict[str, Any], folder: Path) -> list[Path]:
    """Write splatting_time.png and splatting_stages.png."""
    return [_times(result, folder), _stages(result, folder)]


def _times(result: dict[str, Any], folder: Path) -> Path:
    from matplotlib import ticker

    figure, axes = figures.new(1, 2, 4.6, 4.2)
    rows = result["rows"]
    counts = sorted({row["surfels"] for row in rows if row["spread"] is not None})
    for ax, (kind, title) in zip(axes[0], PANELS.items(), strict=True):
        for i, count in enumerate(counts):
            found = [row for row in rows if row["surfels"] == count and row["spread"] is not None]
            ax.plot(
                [row["contributing"] for row in found],
                [row[f"{kind}_ms"] for row in found],
                MARKERS[i % len(MARKERS)],
                color=SHADES[i % len(SHADES)],
                ms=4,
                label=f"ours, {count:,} surfels",
            )
        _others(ax, rows, kind)
        pairs = [float(row["contributing"]) for row in rows]
        x = np.geomspace(min(pairs), max(pairs), 50)
        ax.plot(x, 1e-6 * x * FLOPS[kind] / result["peaks"]["gflops"], "k-", lw=1, label="limit: peak FMA")
        bytes_ms = [1e-6 * row[f"bytes_{kind}"] / result["peaks"]["gbytes"] for row in rows]
        ax.plot(pairs, bytes_ms, "k_", ms=5, label="bytes at peak bandwidth")
        fit = result["fits"][kind]
        y = fit["a"] + fit["b"] * x
        ax.plot(x[y > 0], y[y > 0], ":", color="#2171b5", lw=1, label="straight fit")
        ax.set(xscale="log", yscale="log", xlabel="contributing surfel-pixel pairs")
        ax.xaxis.set_minor_formatter(ticker.NullFormatter())
        ax.set_title(f"{title} (fit: R² = {fit['r2']:.3f})")
    axes[0, 0].set_ylabel("milliseconds")
    named = {
        text: handle for ax in axes[0] for handle, text in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    axes[0, 1].legend(
        named.values(), named.keys(), fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5)
    )
    return figures.save(figure, folder / "splatting_time.png")


def _others(ax: Any, rows: list[dict[str, Any]], kind: str) -> None:
    for name, colour, marker, text in (
        ("volprim", "#c0392b", "x", "volprim_rf_basic"),
        ("raster", "#2a9d5c", "+", "NumPy"),
    ):
        found = [row for row in rows if row[f"{name}_{kind}_ms"]]
        if found:
            x, y = [row["contributing"] for row in found], [row[f"{name}_{kind}_ms"] for row in found]
            ax.plot(x, y, marker, color=colour, ms=5, label=text)
    known = [(row["contributing"], cpp(row)) for row in rows]
    place = 0 if kind == "forward" else 1
    points = [(x, times[place]) for x, times in known if times]
    if points:
        ax.plot(*zip(*points, strict=True), "*", color="#8e44ad", ms=6, label="C++, AVX-512 (older)")


def _stages(result: dict[str, Any], folder: Path) -> Path:
    rows = [row for row in result["rows"] if row["size"] in (256, 512)] or result["rows"]
    rows = rows[-MOST_BARS:]
    figure, axes = figures.new(1, 1, 9.2, 0.6 + 0.3 * len(rows))
    ax = axes[0, 0]
    for i, row in enumerate(rows):
        left = 0.0
        for stage in PHASES:
            if stage == "scatter":
                continue
            width = row[f"{stage}_ms"]
            ax.barh(i, width, left=left, color=BARS[stage], label=stage if i == 0 else None)
            if stage == "adjoint" and row["scatter_ms"]:
                ax.barh(
                    i,
                    row["scatter_ms"],
                    left=left + width - row["scatter_ms"],
                    color="none",
                    edgecolor="white",
                    hatch="////",
                    lw=0,
                    label="scatter, in the adjoint" if i == 0 else None,
                )
            left += width
    ax.set_yticks(range(len(rows)), [label(row) for row in rows], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("milliseconds between barriers, forward and backward")
    ax.legend(fontsize=7, facecolor="#dddddd", edgecolor="none", loc="center left", bbox_to_anchor=(1, 0.5))
    return figures.save(figure, folder / "splatting_stages.png")
