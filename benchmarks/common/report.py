"""Results on disk: CSV, JSON, Markdown tables, numbers that know their floor."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import platform
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.io.files import replace_file


def machine() -> dict[str, Any]:
    """What the times were taken on, and how busy it is: the load average of the last minute."""
    return {
        "cpu": _cpu(),
        "threads": int(dr.thread_count()),
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "variant": mi.variant(),
        "load": f"{os.getloadavg()[0]:.1f}",
    }


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.exists():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    replace_file(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def write_json(path: Path, value: Any) -> None:
    """JSON; refuses NaN and infinity."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line a row, columns in the order of the first row; None is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    write_text(path, text.getvalue())


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Markdown table; numbers to the right; None and no rows at all are empty."""
    body = [["" if cell is None else str(cell) for cell in row] for row in rows]
    if not body:
        return "*Not measured in this run.*"
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(head), rule, *body])


def fill(template: str, values: Mapping[str, Any]) -> str:
    """The text with every {{name}} replaced; raises KeyError for a name that has no value."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: str(values[found[1]]), template)


def number(value: float | None, digits: int = 3) -> str:
    """A few significant figures, without exponents from 0.001 to a million; None is empty."""
    if value is None:
        return ""
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):,.{max(decimals, 0)}f}"


def percent(value: float) -> str:
    """A ratio as a percentage of two figures."""
    return f"{number(100 * value, 2)} %"


def signed(value: float, floor: float = 0.0) -> str:
    """A signed ratio as a percentage, or "< floor"."""
    if abs(value) < floor:
        return f"< {percent(floor)}"
    return f"{'+' if value > 0 else '−'}{percent(abs(value))}"


def floored(relmse: float, floor: float, clear: float) -> str:
    """√relMSE as a percentage, or "< floor" where noise may be all of it."""
    if relmse < clear * floor:
        return f"< {percent((clear * floor) ** 0.5)}"
    return percent(relmse**0.5)
