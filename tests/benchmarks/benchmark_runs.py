"""Runs of the benchmarks as a reader would make them: a fresh process at the root of the repository."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

from tests.helpers import ROOT, run_process

if str(ROOT) not in sys.path:
    sys.path.insert(0, str(ROOT))  # `benchmarks` is no part of the package


def run_benchmark(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """`python -W error -m benchmarks.NAME ARGUMENTS`, whatever comes of it."""
    return run_process("-W", "error", "-m", f"benchmarks.{name}", *arguments)


def small_instance(name: str, folder: Path) -> Path:
    """The folder with the output of the small instance."""
    done = run_benchmark(name, "--small", "--quiet", "-o", folder)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


def read_result(name: str, folder: Path) -> dict[str, Any]:
    """Its JSON."""
    found: dict[str, Any] = json.loads((folder / f"{name}.json").read_text())
    return found
