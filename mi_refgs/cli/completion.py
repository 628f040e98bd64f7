"""`refgs completion`: what a shell sources to complete commands, options and files."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command
from mi_refgs.errors import InputError

SHELLS = ("bash", "zsh", "tcsh")
"""For which shtab writes a script."""
EXAMPLE = "refgs completion bash > ~/.local/share/bash-completion/completions/refgs"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "print the script by which a shell completes commands, options and files"
    parser = add_command(commands, "completion", summary, EXAMPLE, run, kernels=False)
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=f"one of {', '.join(SHELLS)}")


def run(args: argparse.Namespace) -> Result:
    """Write the script from the parser as it is; raises InputError without the package shtab."""
    try:
        import shtab
    except ImportError as error:
        raise InputError(
            'completion: shtab: not installed; type `pip install "mi_refgs[completion]"`'
        ) from error
    from mi_refgs.cli import build_parser

    parser = build_parser()
    for action in _actions(parser):
        if action.type is Path:
            action.complete = shtab.FILE  # type: ignore[attr-defined]
    script = shtab.complete(parser, shell=args.shell)
    return Result({"shell": args.shell, "script": script}, script)


def _actions(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Options and arguments of a parser and of its commands."""
    found = list(parser._actions)
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            found += [inner for command in action.choices.values() for inner in _actions(command)]
    return found
