"""`refgs doctor`: what is installed, or what is in a data set."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "say what is installed, or what is in a data set, what is wrong, and how to mend it"
    parser = add_command(commands, "doctor", summary, "refgs doctor data/glossy", run, kernels=False)
    parser.add_argument(
        "data", type=Path, nargs="?", metavar="DATA", help="data set to look at, instead of the installation"
    )


def run(args: argparse.Namespace) -> Result:
    """Examine a data set, or the installation: exit code 1 if it is unusable."""
    if args.data is not None:
        from mi_refgs.data.survey import survey

        found = survey(args.data)
        return Result(found.to_dict(), found.to_text())
    from mi_refgs.doctor import examine

    report = examine()
    return Result(report.to_dict(), report.to_text(), 0 if report.usable else 1)
