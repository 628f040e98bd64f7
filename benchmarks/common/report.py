"""Options of the command line, Markdown tables and pages."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.build import RESULTS, read_result, recorded, text_of, write_result
from benchmarks.common.view import ROOT
from mi_refgs.errors import InputError
from mi_refgs.io.files import write_bytes

Row = dict[str, Any]

NUMERIC = re.compile(r"$|[<>≥~±+−-]?\s?\d|[–●]")
"""How a cell of a number, an empty one or a mark begins."""


def where(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Rows that have all these values; a tuple or list means any of them."""

    def fits(row: Row) -> bool:
        return all(row[k] in v if isinstance(v, tuple | list) else row[k] == v for k, v in values.items())

    return [row for row in rows if fits(row)]


def write_text(path: Path, text: str) -> None:
    """Write a file atomically, and make its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, text.encode())


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
    parser.add_argument("-o", "--output", type=Path, help="folder; without it docs/ and benchmarks/results/")
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
    """Measure, or read `options.json`; write JSON and page. The exit code: 2 for bad input.

    `plot` writes its images of the result to a folder; `page` returns what the template page.md of the
    benchmark leaves open: tables and numbers by name.
    """
    folder, data = (options.output,) * 2 if options.output else (ROOT / "docs", RESULTS)
    try:
        result = read_result(options.json) if options.json else recorded(measure)
        result = write_result(data / f"{name}.json", result)
        plot(result, folder / "images")
        write_text(folder / f"{name}.md", page_text(name, values_of(result, page)))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(folder / f"{name}.md")
    return 0


def values_of(result: dict[str, Any], page: Callable[[dict[str, Any]], dict[str, Any]]) -> dict[str, Any]:
    """Return tables and numbers of a result by name: those of `page`, its settings, its build and time.

    Raises InputError for a result without a build.
    """
    if "build" not in result:
        raise InputError("--json: build: missing; the result is of an earlier version, measure it again")
    build = result["build"] | {"build": text_of(result["build"])}
    build["load"] = "{:.1f} before and {:.1f} after".format(*result["build"]["load"])
    minutes = {"minutes": f"{result['seconds'] / 60:.1f}"}
    return build | minutes | result.get("settings", {}) | page(result)


def page_text(name: str, values: Mapping[str, Any]) -> str:
    """Return the page of a benchmark: its template with values."""
    template = (ROOT / "benchmarks" / name / "page.md").read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: str(values[found[1]]), template)
