"""Hard cases against a float64 reference.

    python -m benchmarks.stability                     every case, in 15 minutes on 2 cores
    python -m benchmarks.stability --only light -o out cases whose name contains a word; repeatable
    python -m benchmarks.stability --small -o out      one case

Writes stability.json; `python -m benchmarks.pages` makes the tables and the plot of docs/stability.md."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from typing import Any

import drjit as dr
from tqdm import tqdm

from benchmarks.common.report import benchmark
from benchmarks.stability import bias, response
from benchmarks.stability.cases import catalogue
from benchmarks.stability.measure import IMAGE_LIMIT, measure as measure_case


@dataclass(frozen=True)
class Settings:
    """One run: all that the page shows, or `only` cases whose name contains one of these words."""

    only: tuple[str, ...] = ()


def measure(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Measure; `failed` has a line for each case that does not hold."""
    only = settings.only
    chosen = [case for case in catalogue() if any(word in case.name for word in only or [""])]
    rows = []
    for case in tqdm(chosen, desc="cases", disable=quiet):
        rows.append(_finite(measure_case(case, floors=case.quick).record()))
        dr.flush_malloc_cache()  # an image of 4096² leaves gigabytes
    result: dict[str, Any] = {"rows": rows}
    result |= {name: [] for name in ("curve", "losses", "rules", "gradient")}
    if not only:
        result |= {name: [_finite(row) for row in found] for name, found in response.measure().items()}
        result |= bias.measure()
    return result | {"failed": failures(result)}


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
    return lines


def _misses(row: dict[str, Any]) -> bool:
    return not all(row[key] is not None and row[key] <= IMAGE_LIMIT for key in ("value", "slope"))


def main() -> int:
    """Measure; returns the exit code of `benchmark`."""
    return benchmark("stability", __doc__, measure, Settings(), Settings(("one surfel",)), ("--only", "only"))


if __name__ == "__main__":
    sys.exit(main())
