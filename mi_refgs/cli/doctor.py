"""`refgs doctor`: what this installation stands on."""

from __future__ import annotations

import argparse
from typing import Any

from mi_refgs.cli.command import Result, add_command


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "say what this installation stands on, what is wrong, and the command that mends it"
    add_command(commands, "doctor", summary, "refgs doctor", run, kernels=False)


def run(args: argparse.Namespace) -> Result:
    """Examine the installation; exit code 1 if it is unusable."""
    from mi_refgs.doctor import examine

    report = examine()
    return Result(report.to_dict(), report.to_text(), 0 if report.usable else 1)
