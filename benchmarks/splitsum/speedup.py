"""What the path tracer takes to be as good as the split sum, in multiples of the split sum's time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common.errors import CLEAR
from benchmarks.common.select import Row, where
from benchmarks.splitsum.settings import CONVEX

METHOD = "split_sum"
CASE = ("shape", "light", "roughness", "metallic")
Times = dict[tuple[str, str, str], dict[int, float]]
"""Milliseconds per megapixel by shape, light and method, then by setting."""


def line(times: dict[int, float]) -> Callable[[float], float]:
    """Time as a function of the samples: the line that fits best in relative terms, positive at 0."""
    n, t = (np.array(list(x), np.float64) for x in (times.keys(), times.values()))
    design = np.stack([1 / t, n / t], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, np.ones(len(n)), rcond=None)
    if offset < 0 or slope < 0:
        offset, slope = 0.0, float(np.median(t / n))
    return lambda samples: float(offset + slope * samples)


def time_of(times: Times, row: Row) -> float | None:
    """Of a row: measured, or on the straight line through the measured ones."""
    known = times.get((row["shape"], row["light"], row["method"]), {})
    if row["setting"] in known:
        return known[row["setting"]]
    return line(known)(row["setting"]) if len(known) > 1 else None


def error_times_samples(points: list[tuple[int, float, float]]) -> float:
    """c of relMSE = c / samples through (samples, relMSE, floor), floors taken off; a mean of logarithms."""
    clear = [(n, e - floor) for n, e, floor in points if e > CLEAR * floor]
    chosen = clear or [(n, e) for n, e, _ in points]
    return float(np.exp(np.mean([np.log(n * e) for n, e in chosen])))


def exponent(points: list[tuple[int, float, float]]) -> float | None:
    """Slope of log relMSE over log samples, floors taken off: -1 for independent samples."""
    clear = [(n, e - floor) for n, e, floor in points if e > CLEAR * floor]
    if len(clear) < 2:
        return None
    x, y = np.log(np.array(clear)).T
    return float(np.polyfit(x, y, 1)[0])


def speed_ups(rows: list[Row], times: Times) -> list[dict[str, Any]]:
    """One record for each convex shape, light, material and height: samples, and the ratio of times.

    Where the split sum's error is below the noise floor the ratio is a lower bound, taken at the floor. The
    path tracer cannot take less than one sample.
    """
    found = []
    for row in where(rows, method=METHOD, n_dot_v="all", shape=CONVEX):
        case = {key: row[key] for key in CASE}
        paths = [
            (path["setting"], path["relmse"], path["relmse_floor"])
            for path in where(rows, method="path", **case)
        ]
        spp = error_times_samples(paths) / max(row["relmse"], CLEAR * row["relmse_floor"])
        path_ms = line(times[row["shape"], row["light"], "path"])(max(spp, 1))
        split_ms = times[row["shape"], row["light"], METHOD][row["setting"]]
        found.append(
            case
            | {
                "height": row["setting"],
                "lower_bound": row["below_floor"],
                "path_spp": spp,
                "speed_up": path_ms / split_ms,
                "path_exponent": exponent(paths),
            }
        )
    return found
