"""The build that a result was measured with: commit, machine, versions, load."""

from __future__ import annotations

import datetime
import hashlib
import json
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import drjit as dr  # isort: skip

from benchmarks.common.view import ROOT
from mi_refgs.errors import InputError
from mi_refgs.io.files import make_folder, read_json, write_bytes
from mi_refgs.kernels import device

RESULTS = ROOT / "benchmarks" / "results"  # data files of the pages
CODE = ("mi_refgs", "benchmarks", "scenes", "variants", ":!benchmarks/results", ":!*.md")
"""What results depend on, for git."""
SAME = ("commit", "cpu", "cores", "mitsuba", "drjit", "llvm")  # what the rows of a table have in common
DIGITS = 7  # significant digits of the numbers in a data file


def commit() -> str:
    """Return the last commit of the code, with "+" and a digest if it has changes; else "unknown"."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(ROOT), *arguments, "--", *CODE]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        last = git("log", "-1", "--abbrev=10", "--format=%h")
        new = git("ls-files", "--others", "--exclude-standard").splitlines()
        changes = git("diff", "HEAD").encode() + b"".join((ROOT / path).read_bytes() for path in new)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return last + (f"+{hashlib.sha256(changes).hexdigest()[:7]}" if changes else "")


def recorded(measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return a result with its `build` and its `seconds` of wall time, unless it states its own.

    Raises InputError if the code changes meanwhile."""
    before, load, begin = commit(), os.getloadavg()[0], time.perf_counter()
    result = measure()
    if commit() != before:
        raise InputError(f"{ROOT}: code: it has changed during a measurement; run the same again")
    version = dr.detail.llvm_version() if dr.has_backend(dr.JitBackend.LLVM) else ()
    build = device.machine() | {
        "llvm": ".".join(map(str, version)),
        "commit": before,
        "clean": "+" not in before and before != "unknown",
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "load": [round(load, 2), round(os.getloadavg()[0], 2)],  # before and after
    }
    return {"build": build, "seconds": time.perf_counter() - begin, **result}


def merged(builds: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the build of several results with the largest loads; raises InputError if SAME differ."""
    for key in SAME:
        if len(found := {build[key] for build in builds}) > 1:
            raise InputError(f"results: {key}: {' and '.join(sorted(map(str, found)))}; measure all with one")
    loads = zip(*(build["load"] for build in builds), strict=True)
    return builds[-1] | {"load": [*map(max, loads)]}


def text_of(build: dict[str, Any]) -> str:
    """Return commit, machine, load and date in words."""
    last, changed, _ = build["commit"].partition("+")
    name = f"{last} with changes" if changed else last
    load = "load {:.1f} to {:.1f}".format(*build["load"])
    return f"commit {name}, {build['cpu']}, {build['cores']} cores, {load}, {build['date']}"


def write_result(path: Path, result: dict[str, Any]) -> dict[str, Any]:
    """Write a data file, a line per row; returns its content. Raises InputError if it cannot be written.

    Rows of the same keys are lists of values, whose keys are in `columns`."""
    text = json.dumps(result, allow_nan=False)
    whole = json.loads(text, parse_float=lambda x: float(f"{float(x):.{DIGITS}g}"))
    written = dict(whole)
    if rows := written.pop("rows", []):
        columns = list(rows[0])
        if all(list(row) == columns for row in rows):
            written["columns"], rows = columns, [list(row.values()) for row in rows]
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in written.items()]
    if "rows" in whole:
        lines.append('"rows": [' + ",\n".join(map(json.dumps, rows)) + "]")
    make_folder(path.parent)
    write_bytes(path, ("{\n" + ",\n".join(lines) + "\n}\n").encode())
    return dict(whole)


def read_result(path: Path) -> dict[str, Any]:
    """Return what `write_result` was given. Raises InputError as `read_json` does."""
    result: dict[str, Any] = read_json(path)
    if columns := result.pop("columns", None):
        result["rows"] = [dict(zip(columns, row, strict=True)) for row in result["rows"]]
    return result
