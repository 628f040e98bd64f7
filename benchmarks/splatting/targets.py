"""What is asked of the splatter, and what a run says to it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from benchmarks.common.report import number

Row = dict[str, Any]

HAND_WRITTEN = {
    (1_000, 256, 1.5): (4.1, 8.7),
    (10_000, 256, 1.5): (7.2, 16.3),
    (10_000, 512, 1.5): (17.5, 35.6),
    (50_000, 256, 1.5): (20.0, 41.7),
    (50_000, 512, 1.5): (33.4, 67.1),
    (10_000, 256, 0.75): (7.4, 15.1),
    (50_000, 512, 0.75): (39.9, 71.4),
}
"""Milliseconds (forward, forward + backward) by surfels, size and spread, of a hand-written AVX-512 C++
rasteriser with tiles of 16² pixels; measured once, on two threads of another CPU of the same class."""
RATIO = 30.0
"""Times as fast as `volprim_rf_basic`, forward + backward."""
HEADLINE = ((50_000, 256), (50_000, 512))
"""(Surfels, size) of the cases that are asked about."""
SHARE = 0.4
"""Contributing of evaluated surfel-pixel pairs."""
STEP_RATIO = 1.6
"""Training step over its own splat, forward and backward, called alone."""
SPEEDUP = 2.0
"""Training step, against the starting point."""
R2 = 0.98
MEMORY = 8 * 2**30
"""Bytes that a training step at a million surfels and 1024² may take."""
IMAGE_ERROR, GRADIENT_ERROR = 1e-4, 1e-3
WHAT = {"forward": "forward", "both": "forward + backward", "kernels": "blend and adjoint alone"}
START = (20_000, 200)
"""(Surfels, size) of the training step of the starting point."""


class Verdict(NamedTuple):
    """One thing that is asked."""

    what: str
    asked: str
    found: str
    met: bool


def at_least(what: str, limit: float, found: float, unit: str = "×") -> Verdict:
    """Larger is better."""
    return Verdict(what, f"≥ {limit:g}{unit}", f"{number(found)}{unit}", found >= limit)


def at_most(what: str, limit: float, found: float, unit: str = "×") -> Verdict:
    """Smaller is better."""
    return Verdict(what, f"≤ {limit:g}{unit}", f"{number(found)}{unit}", found <= limit)


def where(rows: list[Row], **values: Any) -> list[Row]:
    """Rows that have all these values."""
    return [row for row in rows if all(row[key] == value for key, value in values.items())]


def label(row: Row) -> str:
    """A case in words."""
    size = f"{row['size']}²"
    if row["spread"] is None:
        return f"{row['case']}, {row['surfels']:,}, {size}"
    return f"{row['surfels']:,}, {size}, k = {row['spread']:g}"


def cpp(row: Row) -> tuple[float, float] | None:
    """Times of the hand-written rasteriser, where there are any."""
    return HAND_WRITTEN.get((row["surfels"], row["size"], row["spread"])) if row["spread"] else None


def verdicts(result: dict[str, Any]) -> list[Verdict]:
    """All that this run can tell."""
    return [*_of_cases(result["rows"]), *_of_step(result), *_of_fits(result), *_of_errors(result)]


def _of_cases(rows: list[Row]) -> Iterator[Verdict]:
    asked = [row for row in rows if (row["surfels"], row["size"]) in HEADLINE]
    for row in asked:
        if row["volprim_both_ms"]:
            yield at_least(f"volprim / ours, {label(row)}", RATIO, row["volprim_both_ms"] / row["both_ms"])
    for row in asked:
        known = cpp(row)
        if known:
            yield at_most(f"forward + backward, {label(row)}, as C++", known[1], row["both_ms"], " ms")
    for row in asked:
        yield at_least(f"contributing share, {label(row)}", 100 * SHARE, 100 * row["share"], " %")


def _of_step(result: dict[str, Any]) -> Iterator[Verdict]:
    step = result["step"]
    for name, stage in step["stages"].items():
        ratio = stage["step_ms"] / stage["splat_ms"]
        yield at_most(f"training step / its splat alone, {name}", STEP_RATIO, ratio)
        before = result["baseline"]["stages"].get(name)
        if before and (step["surfels"], step["size"]) == START:
            faster = before["step_ms"] / stage["step_ms"]
            yield at_least(f"start / training step, {name}", SPEEDUP, faster)
    large = result["large_step"]
    if large:
        what = f"memory of a training step, {large['surfels']:,}, {large['size']}²"
        yield at_most(what, MEMORY / 2**30, large["whole_process"] / 2**30, " GiB")


def _of_fits(result: dict[str, Any]) -> Iterator[Verdict]:
    for name, fit in result["fits"].items():
        what = f"R² of {WHAT[name]} over contributing pairs, {fit['decades']:.1f} decades"
        yield at_least(what, R2, fit["r2"], "")
    if result["memory_fit"]:
        yield at_least("R² of peak memory", R2, result["memory_fit"]["r2"], "")


def _of_errors(result: dict[str, Any]) -> Iterator[Verdict]:
    image = max(row["image_max"] for row in result["errors"])
    gradient = max(value for row in result["errors"] for key, value in row.items() if "gradient_" in key)
    yield at_most("image error, largest", IMAGE_ERROR, image, "")
    yield at_most("gradient error, largest", GRADIENT_ERROR, gradient, "")
