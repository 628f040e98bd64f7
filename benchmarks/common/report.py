"""Options of the command line, data files, and Markdown tables."""

from __future__ import annotations

import argparse
import math
import re
import string
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.build import RESULTS, recorded, write_result
from mi_refgs.errors import InputError

Row = dict[str, Any]

NUMERIC = re.compile(r"$|[<>≥~±+−-]?\s?\d|[–●]")  # how a cell of a number, an empty one or a mark begins


def where(rows: Iterable[Row], **values: Any) -> list[Row]:
    """Return the rows that have all these values; a tuple or list means any of them."""

    def fits(row: Row) -> bool:
        return all(row[k] in v if isinstance(v, tuple | list) else row[k] == v for k, v in values.items())

    return [row for row in rows if fits(row)]


def table(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Return a Markdown table; columns of numbers are aligned to the right, None is an empty cell."""
    body = [["" if cell is None else str(cell) for cell in row] for row in rows]
    if not body:
        return "*Not measured in this run.*"
    rule = [
        "---:" if all(NUMERIC.match(cell) for cell in column) else "---" for column in zip(*body, strict=True)
    ]
    return "\n".join("| " + " | ".join(line) + " |" for line in [list(head), rule, *body])


class _Format(string.Formatter):
    """Format strings of a row: "n" and "n2" for 3 and 2 significant figures, None is empty."""

    def format_field(self, value: Any, format_spec: str) -> str:
        if value is None:
            return ""
        if format_spec.startswith("n"):
            return number(value, int(format_spec[1:] or 3))
        return format(value, format_spec)


def row_table(rows: Iterable[Row], columns: Mapping[str, str | Callable[[Row], Any]]) -> str:
    """Return a table with a line per row: title → format string over its keys, or function of the row."""
    made = _Format()

    def cell(show: str | Callable[[Row], Any], row: Row) -> Any:
        return made.vformat(show, (), row) if isinstance(show, str) else show(row)

    return table(list(columns), [[cell(show, row) for show in columns.values()] for row in rows])


def number(value: float | None, digits: int = 3) -> str:
    """Return a few significant figures, without exponents from 0.001 to a million; None is empty."""
    if value is None:
        return ""
    if value == 0:
        return "0"
    if not 1e-3 <= abs(value) < 1e6:
        return f"{value:.{digits - 1}e}"
    decimals = digits - 1 - math.floor(math.log10(abs(value)))
    return f"{round(value, decimals):,.{max(decimals, 0)}f}"


def percent(value: float) -> str:
    """Return a ratio as a percentage of two figures."""
    return f"{number(100 * value, 2)} %"


def plain_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return the parser of `python -m benchmarks.NAME`."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def benchmark(
    name: str,
    description: str | None,
    measure: Callable[[Any, bool], dict[str, Any]],  # of the settings, and whether quiet
    page: Any,
    small: Any = None,
    several: tuple[str, str] = ("", ""),  # a repeatable option, and the settings' field to which it adds
) -> int:
    """Measure by `page`, with --small by `small`, and write NAME.json; returns the exit code: 2 for bad
    input, 1 if the result has cases under "failed", which are printed."""
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    parser, (option, field) = plain_parser(name, description), several
    parser.set_defaults(settings=page)
    parser.add_argument("-o", "--output", type=Path, default=RESULTS, help="folder of the data file")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    if small is not None:
        text = "a coarse instance, below a minute"
        parser.add_argument("--small", action="store_const", const=small, dest="settings", help=text)
    if option:
        parser.add_argument(option, action="append", default=[], dest="several", help="repeatable")
    options = parser.parse_args()
    settings, path = options.settings, options.output / f"{name}.json"
    if option:
        settings = replace(settings, **{field: (*getattr(settings, field), *options.several)})
    try:
        result = write_result(path, recorded(lambda: measure(settings, options.quiet)))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(path)
    print(*result.get("failed", []), sep="\n", end="", file=sys.stderr)
    return int(bool(result.get("failed")))
