"""The plots: time over contributing pairs with the machine's lower bound, and the phases."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures
from benchmarks.splatting.measure import PHASES
from benchmarks.splatting.page import label
from benchmarks.splatting.roofline import FLOPS

SHADES = ("#9ecae1", "#4292c6", "#2171b5", "#08306b")
MARKERS = ("o", "s", "^", "D")
PANELS = {"forward": "forward", "both": "forward + backward"}
BARS = dict(zip(PHASES, ("#bbbbbb", "#f2c14e", "#c77b30", "#4292c6", "#08306b", "#777777"), strict=True))
MOST_BARS = 12


def plot(result: dict[str, Any], folder: Path) -> None:
    """Write splatting_time.png and splatting_phases.png."""
    _times(result, folder)
    _phases(result, folder)


def _times(result: dict[str, Any], folder: Path) -> None:
    from matplotlib import ticker

    figure, axes = figures.new(1, 2, 4.6, 4.2)
    rows = result["rows"]
    counts = sorted({row["surfels"] for row in rows if row["spread"] is not None})
    for ax, (kind, title) in zip(axes[0], PANELS.items(), strict=True):

        def marks(chosen: list[Any], key: str, style: str, colour: str, text: str, ax: Any = ax) -> None:
            points = [(row["contributing"], row[key]) for row in chosen if row[key]]
            if points:
                ax.plot(*zip(*points, strict=True), style, color=colour, ms=4, label=text)

        for i, count in enumerate(counts):
            found = [row for row in rows if row["surfels"] == count and row["spread"] is not None]
            style, colour = MARKERS[i % len(MARKERS)], SHADES[i % len(SHADES)]
            marks(found, f"{kind}_ms", style, colour, f"ours, {count:,} surfels")
        marks(rows, f"volprim_{kind}_ms", "x", "#c0392b", "volprim_rf_basic")
        pairs = [float(row["contributing"]) for row in rows]
        x = np.geomspace(min(pairs), max(pairs), 50)
        ax.plot(x, 1e-6 * x * FLOPS[kind] / result["peaks"]["gflops"], "k-", lw=1, label="limit: peak FMA")
        bytes_ms = [1e-6 * row[f"bytes_{kind}"] / result["peaks"]["gbytes"] for row in rows]
        ax.plot(pairs, bytes_ms, "k_", ms=5, label="bytes at peak bandwidth")
        ax.set(xscale="log", yscale="log", xlabel="contributing surfel-pixel pairs", title=title)
        ax.xaxis.set_minor_formatter(ticker.NullFormatter())
    axes[0, 0].set_ylabel("milliseconds")
    axes[0, 1].legend(fontsize=7, frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    figures.save(figure, folder / "splatting_time.png")


def _phases(result: dict[str, Any], folder: Path) -> None:
    rows = [row for row in result["rows"] if row["size"] in (256, 512)] or result["rows"]
    rows = rows[-MOST_BARS:]
    figure, axes = figures.new(1, 1, 9.2, 0.6 + 0.3 * len(rows))
    ax, left = axes[0, 0], np.zeros(len(rows))
    for phase in PHASES:
        widths = np.array([row[f"{phase.replace(' ', '_')}_ms"] for row in rows])
        ax.barh(range(len(rows)), widths, left=left, color=BARS[phase], label=phase)
        left += widths
    ax.set_yticks(range(len(rows)), [label(row) for row in rows], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("milliseconds between barriers, forward and backward")
    ax.legend(fontsize=7, facecolor="#dddddd", edgecolor="none", loc="center left", bbox_to_anchor=(1, 0.5))
    figures.save(figure, folder / "splatting_phases.png")
