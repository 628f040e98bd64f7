"""`refgs …`: the table of commands, the parser, and errors as sentences with exit codes. A new command is a
module with a dataclass (see command.py) and a line of COMMANDS."""

import contextlib
import importlib
import inspect
import json
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

from mi_refgs import __version__
from mi_refgs.errors import InputError

COMMANDS: dict[str, dict[str, tuple[str, str]]] = {
    "Make data": {
        "dataset": ("dataset:Dataset", "path-trace a multi-view data set of a Mitsuba scene"),
        "capture": ("capture:Capture", "find the cameras of photographs, and make a data set of them"),
    },
    "Fit": {
        "train": ("train:Train", "fit surfels with materials and an environment map to images"),
        "demo": ("demo:Demo", "path-trace a small glossy scene, fit it, and write a contact sheet"),
    },
    "Compare and look": {
        "view": ("view:View", "open a run in the browser: orbit, relight, change materials, save views"),
        "render": ("render:Render", "render a run or a Mitsuba scene to an EXR (linear) or PNG (sRGB) image"),
        "eval": ("evaluate:Eval", "measure a run on its test views: metrics, renders, contact sheets"),
        "compare": ("compare:Compare", "fit data sets with several methods, and tabulate the results"),
    },
    "Use": {
        "relight": ("relight:Relight", "render a run under another environment map, with scores if possible"),
        "edit": ("edit:Edit", "write a new run with surfels changed or cut"),
        "export": ("export:command", "write the files of a run anew, or files of other programs"),
        "import": ("import_splats:Import", "convert a 3DGS or 2DGS PLY to a run folder"),
    },
    "Set up": {"doctor": ("doctor:Doctor", "examine the installation or a data set: problems and remedies")},
}
"""Group → command → its class (or a function that returns it) and summary."""

EXIT_CODES = {
    0: "done",
    1: "the installation is unusable",
    2: "bad input",
    3: "jobs of a comparison failed",
    130: "interrupted",
    141: "the reader of the output closed it (SIGPIPE)",
    143: "terminated (SIGTERM)",
}
"""130, 141 and 143 are the codes of shells for a program that a signal ended: 128 + its number."""


def overview() -> str:
    """Return what `refgs --help` prints."""
    lines = ["usage: refgs COMMAND …", ""]
    lines += ["Reconstruct shiny objects from images as relightable Mitsuba scenes.", ""]
    for group, commands in COMMANDS.items():
        lines += [f"{group}:", *(f"  {name:<12}{summary}" for name, (_, summary) in commands.items()), ""]
    lines += ["refgs COMMAND --help: options, defaults and an example; refgs --version: the version.", ""]
    return "\n".join([*lines, "exit codes:", *(f"  {code:<12}{what}" for code, what in EXIT_CODES.items())])


def command_class(name: str) -> tuple[type[Any], str]:
    """Import a command; returns its class and summary. Raises InputError for an unknown name."""
    known = {name: entry for group in COMMANDS.values() for name, entry in group.items()}
    if name not in known:
        raise InputError("no such command", name, remedy=f"give one of {', '.join(known)}")
    module, _, attribute = known[name][0].partition(":")
    found = getattr(importlib.import_module(f"mi_refgs.cli.{module}"), attribute)
    return found if isinstance(found, type) else found(), known[name][1]


def parse(argv: Sequence[str]) -> Any:
    """Parse a command line without `refgs`; returns an object of its class (command.py). Raises InputError
    for an unknown command, SystemExit after `--help` and for bad options, as tyro does."""
    import tyro
    from tyro.conf import FlagCreatePairsOff, OmitArgPrefixes

    name, *options = argv
    kind, summary = command_class(name)
    description = f"{summary[0].upper()}{summary[1:]}.\n\n{inspect.cleandoc(kind.__doc__ or '')}"
    config = (FlagCreatePairsOff, OmitArgPrefixes)
    return tyro.cli(kind, args=options, prog=f"refgs {name}", description=description, config=config)


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code."""
    try:
        code = _run(sys.argv[1:] if argv is None else list(argv))
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of the output, such as `head`, has read enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the flush at exit would fail again
        return 141
    except OSError as error:
        print(f"refgs: {error}; check the disk and permissions", file=sys.stderr)
        return 2
    return code


def _run(argv: list[str]) -> int:
    if not argv or argv[0] in ("-h", "--help", "--version"):
        print(f"mi_refgs {__version__}" if "--version" in argv else overview())
        return 0
    from mi_refgs.cli.command import UnusableError, finite
    from mi_refgs.runs.interrupt import TerminatedError

    codes: dict[type[BaseException], int] = {InputError: 2, UnusableError: 1}
    codes |= {TerminatedError: 143, KeyboardInterrupt: 130}
    try:
        command = parse(argv)
        with _standard_output_to_error():
            command.common.prepare()
            result = command.run()
    except SystemExit as error:  # of tyro: after --help, or what is wrong with the options
        return int(error.code or 0)
    except tuple(codes) as error:
        code = next(code for kind, code in codes.items() if isinstance(error, kind))
        print(f"refgs: {str(error) or EXIT_CODES[code]}", file=sys.stderr)
        return code
    print(json.dumps(finite(result.data), allow_nan=False) if command.common.json else result.text)
    return int(result.code)


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """Redirect what libraries print, C++ included: standard output has the result; warnings are told."""
    from mi_refgs.io.progress import warn

    sys.stdout.flush()
    saved = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr), warnings.catch_warnings():
            warnings.showwarning = lambda message, *_, **__: warn(str(message))
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
