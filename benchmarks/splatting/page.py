"""Tables, numbers and plots of the page."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.common import figures
from benchmarks.common.report import number, percent, table, where
from benchmarks.splatting.measure import CLASSES, COST, FLOPS, MEMORY, PHASES

CASE = "surfels, image"
MIB = 2**20
Row = dict[str, Any]


def label(row: Row) -> str:
    """A case in words."""
    name = f"{row['case']}, " if "case" in row and row["spread"] is None else ""
    spread = "" if row.get("spread") is None else f", k = {row['spread']:g}"
    return name + f"{row['surfels']:,}, {row['size']}²" + spread


def _sized(row: Row) -> str:
    return f"{row['surfels']:,} surfels and {row['size']}²"


def page(result: dict[str, Any]) -> dict[str, Any]:
    """By name in page.md."""
    rows, peaks = result["rows"], result["peaks"]
    ratios = [row["volprim_both_ms"] / row["both_ms"] for row in rows if row["volprim_both_ms"]]
    typical = [*where(rows, surfels=50_000, size=512, spread=1.5), *rows][0]
    return {
        "times": table([CASE, *TIMES], [[label(row), *map(number, _times(row))] for row in rows]),
        "phases": table([CASE, *PHASES], [[label(row), *map(number, _phases(row))] for row in rows]),
        "work": table([CASE, *WORK], [[label(row), *_work(row, peaks["gbytes"])] for row in rows]),
        "errors": table([CASE, *ERRORS], [[label(row), *_errors(row)] for row in result["errors"]]),
        "memory": table(
            [CASE, "listed pairs", "process, MiB", "Dr.Jit, MiB"],
            [[label(row), *_memory(row)] for row in result["memory"]],
        ),
        "compile": table(["kernel cache", "forward, ms", "f. + backward, ms"], _compile(result["compile"])),
        "steps": _steps(result["step"]),
        **{f"step_{name}": number(stage["step_ms"]) for name, stage in result["step"].items()},
        "brief": _brief(rows, result["errors"]),
        "typical_ms": number(typical["both_ms"]),
        "typical_volprim_s": number((typical["volprim_both_ms"] or 0) / 1e3),
        "cost": _sum(result["cost"], "ms", 1, "ns", 1e6, COST),
        "peak": _sum(result["memory_fit"], "MiB", 1 / MIB, "B", 1, MEMORY),
        "least_ratio": number(min(ratios), 2),
        "median_ratio": number(float(np.median(ratios)), 2),
        "most_ratio": number(max(ratios), 2),
        "image_error": f"{max(row['image'] for row in result['errors']):.0e}",
        "gradient_error": f"{max(r[f'gradient_{n}'] for r in result['errors'] for n in CLASSES):.0e}",
        "compiled_warm": sum(row["misses_forward"] + row["misses_both"] for row in rows),
        "gflops": number(peaks["gflops"]),
        "gbytes": number(peaks["gbytes"]),
        "step_surfels": f"{result['settings']['step'][0]:,}",
        "step_size": result["settings"]["step"][1],
        "compile_case": _sized(result["compile"]),
        "large_case": _sized(result["large_step"]),
        "large_seconds": number(result["large_step"]["ms"] / 1e3),
        "large_gib": f"{result['large_step']['whole_process'] / 2**30:.2f}",
        "scenes": ", ".join(f"`{row['case']}`" for row in rows if row["spread"] is None) or "none",
    }


TIMES = (
    "forward", "f. + backward", "colour, f. + b.", "volprim, f.", "volprim, f. + b.", "volprim / ours",
    "× bound",
)  # fmt: skip


def _times(row: Row) -> list[float | None]:
    volprim, both = row["volprim_both_ms"], row["both_ms"]
    shown = (row["forward_ms"], both, row["colour_both_ms"], row["volprim_forward_ms"], volprim)
    return [*shown, volprim / both if volprim else None, both / row["bound_both_ms"]]


def _phases(row: Row) -> list[float]:
    return [row[f"{phase.replace(' ', '_')}_ms"] for phase in PHASES]


def _brief(rows: list[Row], errors: list[Row]) -> str:
    """Cases of which volprim and errors were measured, too."""
    names = ("surfels", "size", "spread")
    wrong = {tuple(row[name] for name in names): row for row in errors}
    both = [(row, wrong.get(tuple(row[name] for name in names))) for row in rows if row["volprim_both_ms"]]
    lines = [
        [
            label(row),
            *(f"{number(row[key])} ms" for key in ("both_ms", "volprim_both_ms")),
            *_errors(found)[1:2],
        ]
        for row, found in both
        if found is not None
    ]
    return table(
        [CASE, "ours, 16 channels", "`volprim_rf_basic`, colour only", "largest error of the image"], lines
    )


WORK = (
    "listed", "evaluated", "contribute", "share", "layers", "MiB, f. / f. + b.", "of the bandwidth",
    "launches, f. / f. + b.",
)  # fmt: skip


def _work(row: Row, gbytes: float) -> list[str]:
    return [
        *(f"{row[name]:,}" for name in ("pairs", "evaluated", "contributing")),
        percent(row["share"]),
        number(row["contributing"] / max(row["covered"], 1)),
        f"{row['bytes_forward'] / MIB:.0f} / {row['bytes_both'] / MIB:.0f}",
        percent(1e-6 * row["bytes_both"] / row["both_ms"] / gbytes),
        f"{row['launches_forward']} / {row['launches_both']}",
    ]


ERRORS = ("order", "image", "depth and normals", *(f"∂ {name}" for name in CLASSES), "left out")


def _errors(row: Row) -> list[str]:
    found = [row[name] for name in ("order", "image", "maps", *(f"gradient_{name}" for name in CLASSES))]
    return [*(f"{x:.1e}" if x else "0" for x in found), percent(row["left_out"])]


def _memory(row: Row) -> list[str]:
    return [f"{row['pairs']:,}", f"{row['peak'] / MIB:.0f}", f"{row['allocated'] / MIB:.0f}"]


def _compile(found: Row) -> list[list[str]]:
    names = {"cold": "empty", "cached": "filled by an earlier process", "warm": "second call of a process"}
    return [
        [text, *(f"{found[key][kind]:.0f}" for kind in ("forward", "both"))] for key, text in names.items()
    ]


def _steps(stages: dict[str, Any]) -> str:
    """A training step by phase, a column for each stage of the schedule."""
    whole = {"**step**": "step_ms", "splat alone": "splat_ms", "launches": "launches"}
    columns = [s["phases_ms"] | {text: s[key] for text, key in whole.items()} for s in stages.values()]
    names = list(dict.fromkeys(name for column in columns for name in column))
    return table(["", *stages], [[name, *(number(column.get(name)) for column in columns)] for name in names])


WORDS = {"contributing": "contributing pair", "pairs": "listed pair", "surfels": "surfel", "pixels": "pixel"}


def _sum(
    fit: Row | None, unit: str, scale: float, small: str, small_scale: float, names: Sequence[str]
) -> str:
    """A fit of `measure.plane` as a formula."""
    if fit is None:
        return "(not fitted)"
    terms = [f"{number(scale * fit['constant'])} {unit}"]
    terms += [f"{number(small_scale * fit[name])} {small} per {WORDS[name]}" for name in names]
    return f"{' + '.join(terms)} (R² = {fit['r2']:.3f}, worst residual {100 * fit['worst']:.0f} %)"


SHADES = ("#9ecae1", "#4292c6", "#2171b5", "#08306b")
MARKERS = ("o", "s", "^", "D")
PANELS = {"forward": "forward", "both": "forward + backward"}
BARS = dict(zip(PHASES, ("#bbbbbb", "#f2c14e", "#c77b30", "#4292c6", "#08306b", "#777777"), strict=True))
MOST_BARS = 12


def plot(result: dict[str, Any], folder: Path) -> None:
    """Write splatting_time.png and splatting_phases.png."""
    figures.save(_plot_times(result), folder / "splatting_time.png")
    figures.save(_plot_phases(result), folder / "splatting_phases.png")


def _plot_times(result: dict[str, Any]) -> Any:
    from matplotlib import ticker

    figure, axes = figures.new(1, 2, 4.6, 4.2)
    rows = result["rows"]
    counts = sorted({row["surfels"] for row in rows if row["spread"] is not None})
    for ax, (kind, title) in zip(axes[0], PANELS.items(), strict=True):

        def marks(chosen: list[Any], key: str, style: str, colour: str, text: str, ax: Any = ax) -> None:
            points = [(row["contributing"], row[key]) for row in chosen if row[key]]
            if points:
                ax.plot(*zip(*points, strict=True), style, color=colour, ms=4, label=text)

        for count, style, colour in zip(counts, cycle(MARKERS), cycle(SHADES), strict=False):
            found = [row for row in rows if row["surfels"] == count and row["spread"] is not None]
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
    return figure


def _plot_phases(result: dict[str, Any]) -> Any:
    rows = [row for row in result["rows"] if row["size"] in (256, 512)] or result["rows"]
    rows = rows[-MOST_BARS:]
    figure, axes = figures.new(1, 1, 9.2, 0.6 + 0.3 * len(rows))
    ax, left = axes[0, 0], np.zeros(len(rows))
    for phase in PHASES:
        widths = np.array([_phases(row)[PHASES.index(phase)] for row in rows])
        ax.barh(range(len(rows)), widths, left=left, color=BARS[phase], label=phase)
        left += widths
    ax.set_yticks(range(len(rows)), [label(row) for row in rows], fontsize=7)
    ax.invert_yaxis()
    ax.set_xlabel("milliseconds between barriers, forward and backward")
    ax.legend(fontsize=7, facecolor="#dddddd", edgecolor="none", loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
