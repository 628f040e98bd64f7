"""Write the numbers of benchmarks/results/ into the pages: python -m benchmarks.pages

A marker <!-- FILE.NAME --> … <!-- / --> contains what FILE.json says: a number, or a table, whose caption is
left out if the page has it already.
<!-- caption.FILE.FILE --> is the caption of a table whose cells contain markers. Where FILE.json is missing,
the text stays. results/settings.toml lists, by page, the numbers that nothing measures, such as bounds."""

from __future__ import annotations

import re
import sys
import tomllib
from functools import lru_cache
from pathlib import Path
from typing import Any

from benchmarks import tables
from benchmarks.common import build
from benchmarks.common.report import plain_parser
from benchmarks.common.view import ROOT
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file, write_bytes

SETTINGS: dict[str, list[str]] = tomllib.loads((build.RESULTS / "settings.toml").read_text(encoding="utf-8"))
PAGES = tuple(SETTINGS)
MARKER = re.compile(r"<!-- (\w+)\.([\w.]+) -->(.*?)<!-- / -->", flags=re.DOTALL)
CODE = re.compile(r"```.*?```|`[^`\n]*`", flags=re.DOTALL)
UNIT = r"(?:dB|°|%|ms|s|h|minutes|times|[kMG]i?B|frames per second)(?![\w*])"
MEASURED = re.compile(rf"\d[\d.,]*\s?{UNIT}|^\|[^\n]*[ (,]{UNIT}[^\n]*(?=\n\|[-:| ]+$)", flags=re.MULTILINE)
"""A number with its unit, or a table's head with one."""


@lru_cache
def values(path: Path) -> dict[str, Any]:
    """Return the tables and numbers of a data file by name; raises InputError for rows of several builds."""
    result = build.read_result(path)
    return tables.values(path.stem, result) | {"about": result["build"]}


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

    Raises InputError for an unknown name, and for captions of several builds."""
    captions: set[str] = set()

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
            content = f"\n\n{content}\n\n{'' if caption in captions else caption}"
            captions.add(caption)
        return f"<!-- {found[1]}.{found[2]} -->{content}<!-- / -->"

    return MARKER.sub(replaced, text)


def unmarked(text: str) -> list[str]:
    """Return what MEASURED finds outside of markers and code."""
    return [re.sub(r"\s", " ", found) for found in MEASURED.findall(CODE.sub("", MARKER.sub("", text)))]


def rewritten(folder: Path = build.RESULTS) -> dict[Path, str]:
    """Return the pages with the numbers of the data files in a folder. Raises InputError as `filled`."""
    return {ROOT / page: filled((ROOT / page).read_text(encoding="utf-8"), folder) for page in PAGES}


def main(arguments: list[str] | None = None) -> int:
    """Write the pages, and name those that change; exit code 2 for data files that do not fit."""
    plain_parser("pages", __doc__).parse_args(arguments)
    try:
        for path, text in rewritten().items():
            if text != path.read_text(encoding="utf-8"):
                write_bytes(path, text.encode())
                print(path)
    except InputError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
