"""What the benchmarks' command lines share: options, where reports go, exit codes."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.lights import ROOT
from benchmarks.common.report import fill, write_csv, write_json, write_text
from mi_refgs.errors import InputError


def plain_parser(name: str, description: str | None) -> argparse.ArgumentParser:
    """Parser of `python -m benchmarks.NAME`."""
    return argparse.ArgumentParser(
        prog=f"python -m benchmarks.{name}",
        description=description,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def make_parser(
    name: str, description: str | None, page: Any = None, **sizes: tuple[Any, str]
) -> argparse.ArgumentParser:
    """With the options that all pages have, and a flag for each other size than that of the page.

    `sizes`: settings and help. `options.settings` are the chosen ones. Sets Mitsuba's variant.
    """
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    parser = plain_parser(name, description)
    parser.set_defaults(settings=page)
    parser.add_argument("-o", "--output", type=Path, help="folder; without it docs/ and runs/")
    parser.add_argument(
        "--json", type=Path, metavar="FILE", help="write page and pictures of this earlier run"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    group = parser.add_mutually_exclusive_group()
    for flag, (settings, text) in sizes.items():
        group.add_argument(f"--{flag}", action="store_const", dest="settings", const=settings, help=text)
    return parser


def write_reports(
    name: str,
    options: argparse.Namespace,
    measure: Callable[[], dict[str, Any]],
    plot: Callable[[dict[str, Any], Path], Any],
    page: Callable[[dict[str, Any]], dict[str, Any]],
) -> int:
    """Measure, or read `options.json`; write JSON, CSV (of "rows") and page. The exit code: 2 for bad input.

    `plot` writes its pictures of the result to a folder; `page` returns what the template page.md of the
    benchmark leaves open: tables and numbers by name. The machine and the run's minutes are added.
    """
    folder, data = (options.output,) * 2 if options.output else (ROOT / "docs", ROOT / "runs")
    try:
        result = json.loads(options.json.read_text(encoding="utf-8")) if options.json else measure()
        write_json(data / f"{name}.json", result)
        write_csv(data / f"{name}.csv", result["rows"])
        plot(result, folder / "images")
        values = result["machine"] | {"minutes": f"{result['seconds'] / 60:.1f}"} | page(result)
        template = (ROOT / "benchmarks" / name / "page.md").read_text(encoding="utf-8")
        write_text(folder / f"{name}.md", fill(template, values))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    print(folder / f"{name}.md")
    return 0
