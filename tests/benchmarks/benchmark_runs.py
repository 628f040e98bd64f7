"""Runs of the benchmarks as a reader would make them: a fresh process at the root of the repository."""

from __future__ import annotations

import subprocess

from tests.helpers import run_process


def run_benchmark(name: str, *arguments: object) -> subprocess.CompletedProcess[str]:
    """`python -W error -m benchmarks.NAME ARGUMENTS`, whatever comes of it."""
    return run_process("-W", "error", "-m", f"benchmarks.{name}", *arguments)
