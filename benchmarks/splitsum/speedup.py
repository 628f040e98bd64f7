"""What the path tracer takes to be as good as the split sum, in multiples of the split sum's time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.common.errors import CLEAR
from benchmarks.splitsum.settings import CONVEX, Settings

METHOD = "split_sum"


def line(times: dict[int, float]) -> Callable[[float], float]:
    """Time as a function of the samples: the line that fits best in relative terms, positive at 0."""
    n, t = (np.array(list(x), np.float64) for x in (times.keys(), times.values()))
    design = np.stack([1 / t, n / t], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, np.ones(len(n)), rcond=None)
    if offset < 0 or slope < 0:
        offset, slope = 0.0, float(np.median(t / n))
    return lambda samples: float(offset + slope * samples)


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


def speed_ups(
    rows: list[dict[str, Any]], times: dict[tuple[str, str, str, int], float], settings: Settings
) -> list[dict[str, Any]]:
    """One record for each convex shape, light, material and height: samples, times, their ratio.

    Where the split sum's error is below the noise floor the ratio is a lower bound, taken at the floor. The
    path tracer cannot take less than one sample.
    """
    every = [row for row in rows if row["n_dot_v"] == "all" and row["shape"] in CONVEX]
    paths: dict[tuple[Any, ...], list[tuple[int, float, float]]] = {}
    for row in every:
        if row["method"] == "path":
            point = (row["setting"], row["relmse"], row["relmse_floor"])
            paths.setdefault(_case(row), []).append(point)
    found = []
    for row in every:
        if row["method"] != METHOD:
            continue
        case, place = _case(row), (row["shape"], row["light"])
        floor = CLEAR * row["relmse_floor"]
        spp = error_times_samples(paths[case]) / max(row["relmse"], floor)
        path_ms = line({key[3]: ms for key, ms in times.items() if key[:3] == (*place, "path")})(max(spp, 1))
        split_ms = times[(*place, METHOD, row["setting"])]
        found.append(
            {
                **dict(zip(("shape", "light", "roughness", "metallic"), case, strict=True)),
                "height": row["setting"],
                "bias": row["bias"],
                "relmse": row["relmse"],
                "lower_bound": row["below_floor"],
                "path_spp": spp,
                "path_ms_per_mpx": path_ms,
                "split_sum_ms_per_mpx": split_ms,
                "speed_up": path_ms / split_ms,
                "path_exponent": exponent(paths[case]),
            }
        )
    return found


def _case(row: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(row[key] for key in ("shape", "light", "roughness", "metallic"))
