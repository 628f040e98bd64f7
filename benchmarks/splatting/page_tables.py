"""The tables of the page."""

from __future__ import annotations

from typing import Any

from benchmarks.common.report import number, percent, table
from benchmarks.splatting.errors import PARAMETERS
from benchmarks.splatting.measure import PHASES
from benchmarks.splatting.targets import cpp, label, where

CASE = "surfels, image"
BACKWARD = ("loss backward", "shade backward", "surfels backward", "prefilter backward")


def _cell(value: float | None, unit: str = "") -> str:
    return "" if value is None else number(value) + unit


def times(result: dict[str, Any]) -> str:
    """Every case by every renderer."""
    rows = []
    for row in result["rows"]:
        other, before = cpp(row), _before(result, row)
        volprim = row["volprim_both_ms"]
        rows.append(
            [
                label(row),
                _cell(row["forward_ms"]),
                _cell(row["both_ms"]),
                _cell(row["colour_both_ms"]),
                _cell(row["raster_forward_ms"]),
                _cell(row["volprim_forward_ms"]),
                _cell(volprim),
                _cell(volprim / row["both_ms"] if volprim else None, "×"),
                f"{other[0]:g} / {other[1]:g}" if other else "",
                _cell(before),
                _cell(row["both_ms"] / row["bound_both_ms"], "×"),
            ]
        )
    head = [
        CASE,
        "forward",
        "f. + backward",
        "colour, f. + b.",
        "NumPy, f.",
        "volprim, f.",
        "volprim, f. + b.",
        "volprim / ours",
        "C++, f. / f. + b.",
        "start, f. + b.",
        "× bound",
    ]
    return table(head, rows)


def _before(result: dict[str, Any], row: dict[str, Any]) -> float | None:
    key = {name: row[name] for name in ("case", "surfels", "size", "spread")}
    found = where(result["baseline"]["cases"], **key)
    return float(found[0]["both_ms"]) if found else None


def stages(result: dict[str, Any]) -> str:
    """Stages of every case."""
    rows = [
        [label(row), *(_cell(row[f"{stage}_ms"]) for stage in PHASES), _cell(row["forward_ms"])]
        for row in result["rows"]
    ]
    return table([CASE, *PHASES, "forward, whole"], rows)


def work(result: dict[str, Any]) -> str:
    """Counts, bytes, launches."""
    rows = []
    for row in result["rows"]:
        gbytes = 1e-6 * row["bytes_both"] / row["both_ms"]
        rows.append(
            [
                label(row),
                f"{row['pairs']:,}",
                f"{row['evaluated']:,}",
                f"{row['contributing']:,}",
                percent(row["share"]),
                number(row["contributing"] / max(row["covered"], 1)),
                f"{row['bytes_forward'] / 2**20:.0f} / {row['bytes_both'] / 2**20:.0f}",
                percent(gbytes / result["peaks"]["gbytes"]),
                f"{row['launches_forward']} / {row['launches_both']}",
            ]
        )
    head = [
        CASE,
        "listed",
        "evaluated",
        "contribute",
        "share",
        "layers",
        "MiB, f. / f. + b.",
        "of the bandwidth",
        "launches, f. / f. + b.",
    ]
    return table(head, rows)


def errors(result: dict[str, Any]) -> str:
    """Of every case that was compared."""
    rows = [
        [
            f"{row['surfels']:,}, {row['size']}², k = {row['spread']:g}",
            f"{row['order']:.0e}" if row["order"] else "0",
            f"{row['image_median']:.1e}",
            f"{row['image_max']:.1e}",
            f"{row['raster_image_median']:.1e}",
            *(f"{row[f'gradient_{name}']:.1e}" for name in PARAMETERS),
            percent(row["left_out"]),
        ]
        for row in result["errors"]
    ]
    gradients = [f"∂ {name}" for name in PARAMETERS]
    head = [CASE, "order", "image, median", "largest", "NumPy, median", *gradients, "left out"]
    return table(head, rows)


def memory(result: dict[str, Any]) -> str:
    """Of every process."""
    rows = [
        [
            f"{row['surfels']:,}, {row['size']}²",
            f"{row['pairs']:,}",
            f"{row['peak'] / 2**20:.0f}",
            f"{row['allocated'] / 2**20:.0f}",
        ]
        for row in result["memory"]
    ]
    return table([CASE, "listed pairs", "process, MiB", "Dr.Jit, MiB"], rows)


def step(result: dict[str, Any]) -> str:
    """The training step beside the starting point."""
    now, before = result["step"]["stages"], result["baseline"]["stages"]
    head, columns = ["", *(f"{name}{mark}" for name in now for mark in ("", ", start"))], []
    for name, stage in now.items():
        ms = stage["stages_ms"]
        ms = ms | {"other backward": sum(ms.get(key, 0.0) for key in BACKWARD)}
        whole = {
            "**step**": stage["step_ms"],
            "splat alone": stage["splat_ms"],
            "launches": stage["launches"],
        }
        columns.append(ms | whole)
        old = before.get(name, {"stages_ms": {}, "step_ms": None, "launches": None})
        columns.append(old["stages_ms"] | {"**step**": old["step_ms"], "launches": old["launches"]})
    names = list(dict.fromkeys(key for column in columns for key in column))
    return table(head, [[name, *(_cell(column.get(name)) for column in columns)] for name in names])
