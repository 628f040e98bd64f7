"""Write the numbers of benchmarks/results/ into the pages: python -m benchmarks.pages

A marker <!-- FILE.NAME --> … <!-- / --> contains what FILE.json says: a table with its caption, or a number.
<!-- caption.FILE.FILE --> is the caption of a table whose cells contain markers. Where FILE.json is missing,
the text stays; stale.toml lists those `files`, by page the `numbers` that no data file contains, and
`settings`: numbers that nothing measures, such as bounds.
"""

from __future__ import annotations

import importlib
import re
import sys
import tomllib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import tomli_w

from benchmarks.common import build
from benchmarks.common.report import number, page_text, plain_parser, values_of, write_text
from benchmarks.common.view import ROOT
from benchmarks.fits import page as fits
from benchmarks.fits.plan import GROUPS
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file

PAGES = ("README.md", "docs/accuracy.md", "docs/speed.md", "docs/photographs_in_detail.md")
TEMPLATES = tuple(sorted(path.parent.name for path in (ROOT / "benchmarks").glob("*/page.md")))
"""Benchmarks that write docs/NAME.md as a whole."""
STALE = build.RESULTS / "stale.toml"
MARKER = re.compile(r"<!-- (\w+)\.([\w.]+) -->(.*?)<!-- / -->", flags=re.DOTALL)
CODE = re.compile(r"```.*?```|`[^`\n]*`", flags=re.DOTALL)
UNIT = r"(?:dB|°|%|ms|s|h|minutes|times|[kMG]i?B|frames per second)(?![\w*])"
MEASURED = re.compile(rf"\d[\d.,]*\s?{UNIT}|^\|[^\n]*[ (,]{UNIT}[^\n]*(?=\n\|[-:| ]+$)", flags=re.MULTILINE)
"""A number with its unit, or a table's head with one."""


@lru_cache
def values(path: Path) -> dict[str, Any]:
    """Return the tables and numbers of a data file by name; raises InputError for rows of several builds."""
    result, name = build.read_result(path), path.stem
    if name in GROUPS:
        return values_of(result, lambda content: fits.values(name, content)) | {"about": result["build"]}
    found: Any = lambda content: dict(_numbers(content["result"]))  # noqa: E731
    if name in TEMPLATES:
        found = importlib.import_module(f"benchmarks.{name}.__main__").page
    return values_of(result, found) | {"about": result["build"]}


def _numbers(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Numbers of nested objects and lists as text, by the path of their keys."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield from _numbers(inner, f"{name}_{key}".strip("_"))
    if isinstance(value, int | float) and not isinstance(value, bool):
        yield name, f"{value:,}" if isinstance(value, int) else number(value)


def files_of(text: str) -> set[str]:
    """Return the names of the data files that the markers of a text name."""
    found = [rest.split(".") if first == "caption" else [first] for first, rest, _ in MARKER.findall(text)]
    return {name for names in found for name in names}


def names_of(file: str) -> set[str]:
    """Return the names in a data file that the markers of PAGES name."""
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    return {name for first, name, _ in MARKER.findall(text) if first == file}


def filled(text: str, folder: Path) -> str:
    """Return a page with the markers filled whose data files are in a folder.

    Raises InputError for an unknown name, and for captions of several builds.
    """

    def replaced(found: re.Match[str]) -> str:
        names = files_of(found[0])
        if not all(is_file(folder / f"{name}.json") for name in names):
            return found[0]
        known = [values(folder / f"{name}.json") for name in sorted(names)]
        text = build.text_of(build.merged([one["about"] for one in known]))
        caption = f"*{text[0].upper()}{text[1:]}.*\n\n"
        if found[1] == "caption":
            content = f"\n\n{caption}"
        elif found[2] not in known[0]:
            raise InputError(f"<!-- {found[1]}.{found[2]} -->: not in the data file; correct the marker")
        elif (content := str(known[0][found[2]])).startswith("|"):
            content = f"\n\n{content}\n\n{caption}"
        return f"<!-- {found[1]}.{found[2]} -->{content}<!-- / -->"

    return MARKER.sub(replaced, text)


def unmarked(text: str) -> list[str]:
    """Return what MEASURED finds outside of markers and code."""
    return [re.sub(r"\s", " ", found) for found in MEASURED.findall(CODE.sub("", MARKER.sub("", text)))]


def rewritten(folder: Path = build.RESULTS) -> dict[Path, str]:
    """Return the pages with the numbers of the data files in a folder. Raises InputError as `filled`."""
    texts = {ROOT / page: filled((ROOT / page).read_text(encoding="utf-8"), folder) for page in PAGES}
    here = [folder / f"{name}.json" for name in TEMPLATES if is_file(folder / f"{name}.json")]
    return texts | {ROOT / "docs" / f"{path.stem}.md": page_text(path.stem, values(path)) for path in here}


def main(arguments: list[str] | None = None) -> int:
    """Write the pages, and name those that change; exit code 2 for data files that do not fit."""
    plain_parser("pages", __doc__).parse_args(arguments)
    try:
        for path, text in rewritten().items():
            if text != path.read_text(encoding="utf-8"):
                write_text(path, text)
                print(path)
        stale = tomllib.loads(STALE.read_text(encoding="utf-8"))
        stale["files"] = [name for name in stale["files"] if not is_file(build.RESULTS / f"{name}.json")]
        write_text(STALE, tomli_w.dumps(stale))
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
