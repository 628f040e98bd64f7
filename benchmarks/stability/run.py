"""The whole run: every case of the catalogue, the response, the fits, the method's own error."""

from __future__ import annotations

import math
import time
from typing import Any

import drjit as dr
from tqdm import tqdm

from benchmarks.common import report
from benchmarks.stability import bias, fits, response
from benchmarks.stability.cases import catalogue
from benchmarks.stability.measure import GRADIENTS, IMAGE_LIMIT, Row
from benchmarks.stability.measure import measure as measure_case


def measure(quick: bool = False, only: list[str] | None = None, quiet: bool = False) -> dict[str, Any]:
    """Everything that the page shows; `only`: cases whose name holds one of these words, and nothing else."""
    begin = time.perf_counter()
    chosen = [case for case in catalogue() if case.quick or not quick]
    if only:
        chosen = [case for case in chosen if any(word in case.name for word in only)]
    rows = []
    for case in tqdm(chosen, desc="cases", disable=quiet):
        rows.append(record(measure_case(case, floors=case.quick)))
        dr.flush_malloc_cache()  # a picture of 4096² leaves gigabytes
    result: dict[str, Any] = {"machine": report.machine(), "rows": rows}
    if not only:
        result |= {name: [_finite(row) for row in found] for name, found in response.measure().items()}
    else:
        result |= {"curve": [], "losses": []}
    more = not (only or quick)
    result["fits"] = fits.measure() if more else []
    result |= bias.measure() if more else {"rules": [], "gradient": []}
    return result | {"seconds": time.perf_counter() - begin}


def record(row: Row) -> dict[str, Any]:
    """For CSV and JSON: one level, None for what is not finite."""
    flat: dict[str, Any] = {
        "case": row.name,
        "image": row.image,
        "maps": row.maps,
        "textbook": row.textbook,
        "ulp_image": row.image_floor,
        "ulp_gradient": max(row.gradient_floor.values(), default=0.0),
        "non_finite": row.non_finite,
        "kept": row.kept,
        "order": row.order,
        "negligible": " ".join(row.negligible),
        "verdict": row.verdict,
    }
    flat |= {f"gradient_{name}": row.gradients.get(name) for name in GRADIENTS}
    return _finite(flat)


def _finite(row: dict[str, Any]) -> dict[str, Any]:
    """None for what is not finite."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def failures(result: dict[str, Any]) -> list[str]:
    """What does not hold, one line each."""
    lines = [f"{row['case']}: {row['verdict']}" for row in result["rows"] if "FAILS" in row["verdict"]]
    for row in result["curve"]:
        if _misses(row):
            lines.append(f"sRGB at {row['at']}: value {row['value']}, slope {row['slope']}")
    for row in result["losses"]:
        if row["non_finite"] or _misses(row):
            lines.append(f"loss, {row['name']}: value {row['value']}, slope {row['slope']}")
    lines += [f"fit, {row['name']}: not finite" for row in result["fits"] if row["non_finite"]]
    return lines


def _misses(row: dict[str, Any]) -> bool:
    return not all(row[key] is not None and row[key] <= IMAGE_LIMIT for key in ("value", "slope"))
