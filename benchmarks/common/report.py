"""Options of the command line, results on disk (CSV, JSON), Markdown tables and pages."""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.view import ROOT
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes
from mi_refgs.kernels import device

Row = dict[str, Any]

NUMERIC = re.compile(r"$|[<>≥~±+−-]?\s?\d|[–●]")
"""How a cell of a number, an empty one or a mark begins."""


def where(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Rows that have all these values; a tuple or list means any of them."""

    def fits(row: Row) -> bool:
        return all(row[k] in v if isinstance(v, tuple | list) else row[k] == v for k, v in values.items())

    return [row for row in rows if fits(row)]


def machine() -> dict[str, Any]:
    """What the times were taken on, and how busy it is: the load average of the last minute."""
    return device.machine() | {"variant": mi.variant(), "load": f"{os.getloadavg()[0]:.1f}"}


def write_text(path: Path, text: str) -> None:
    """Write a file atomically, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """One line a row, columns in the order of the first row; None is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()})
    write_text(path, text.getvalue())


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Markdown table; columns of numbers to the right; None and no rows at all are empty."""
    body = [["" if cell is None else str(cell) for cell in row] for row in rows]
    if not body:
        return "*Not measured in this run.*"
    rule = [
        "---:" if all(NUMERIC.match(cell) for cell in column) else "---" for column in zip(*body, strict=True)
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(head), rule, *body])


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


def plain_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Parser of `python -m benchmarks.NAME`."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def make_parser(
    name: str, description: str | None, page: Any = None, small: Any = None
) -> argparse.ArgumentParser:
    """With the options that all pages have; `options.settings` are `page`, or with --small `small`.

    Sets Mitsuba's variant.
    """
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    parser = plain_parser(name, description)
    parser.set_defaults(settings=page)
    parser.add_argument("-o", "--output", type=Path, help="folder; without it docs/ and runs/")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write page and images of this earlier run")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    if small is not None:
        text = "a coarse instance, below a minute"
        parser.add_argument("--small", action="store_const", dest="settings", const=small, help=text)
    return parser


def write_reports(
    name: str,
    options: argparse.Namespace,
    measure: Callable[[], dict[str, Any]],
    plot: Callable[[dict[str, Any], Path], Any],
    page: Callable[[dict[str, Any]], dict[str, Any]],
) -> int:
    """Measure, or read `options.json`; write JSON, CSV (of "rows") and page. The exit code: 2 for bad input.

    `plot` writes its images of the result to a folder; `page` returns what the template page.md of the
    benchmark leaves open: tables and numbers by name. The machine, the
    settings and the run's minutes are added.
    """
    folder, data = (options.output,) * 2 if options.output else (ROOT / "docs", ROOT / "runs")
    try:
        result = json.loads(options.json.read_text(encoding="utf-8")) if options.json else measure()
        write_text(data / f"{name}.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
        write_csv(data / f"{name}.csv", result["rows"])
        plot(result, folder / "images")
        values = result["machine"] | result.get("settings", {}) | page(result)
        values["minutes"] = f"{result['seconds'] / 60:.1f}"
        template = (ROOT / "benchmarks" / name / "page.md").read_text(encoding="utf-8")
        text = re.sub(r"\{\{(\w+)\}\}", lambda found: str(values[found[1]]), template)
        write_text(folder / f"{name}.md", text)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(folder / f"{name}.md")
    return 0
