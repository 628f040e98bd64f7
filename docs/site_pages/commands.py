"""The page of the commands, made of their `--help`."""

from __future__ import annotations

import contextlib
import io
import os
from unittest import mock

from mi_refgs.cli import COMMANDS, EXIT_CODES, main
from site_pages import table

COLUMNS = "84"
"""Width of the help texts in characters."""


def page() -> str:
    """Return a section per command: its help, with options, defaults and an example."""
    rows = [
        [group, f"[`refgs {name}`](#refgs-{name})", summary]
        for group, commands in COMMANDS.items()
        for name, (_, summary) in commands.items()
    ]
    text = [
        "# Commands",
        "Results go to standard output, progress and warnings to standard error. With `--json`, a command "
        "prints one JSON object and nothing else on standard output.",
        table(["group", "command", "what it does"], rows),
        table(["exit code", "meaning"], [[str(code), meaning] for code, meaning in EXIT_CODES.items()]),
    ]
    for commands in COMMANDS.values():
        for name in commands:
            text.append(f"## refgs {name}\n\n```text\n{help_of(name)}\n```")
    return "\n\n".join(text) + "\n"


def help_of(command: str) -> str:
    """Return what `refgs COMMAND --help` prints."""
    printed = io.StringIO()
    with mock.patch.dict(os.environ, COLUMNS=COLUMNS), contextlib.redirect_stdout(printed):
        main([command, "--help"])
    return printed.getvalue().rstrip()
