"""`refgs …`: one module a command; here the parser, and what turns errors into sentences and exit codes.

Exit codes: 0 done, 1 the installation is unusable, 2 bad input, 3 jobs of a comparison failed, 130
interrupted, 143 terminated (SIGTERM).
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
from collections.abc import Iterator, Sequence

from mi_refgs import __version__
from mi_refgs.cli import (
    capture,
    compare,
    completion,
    dataset,
    demo,
    doctor,
    edit,
    evaluate,
    export,
    import_splats,
    profile,
    relight,
    render,
    train,
    view,
)
from mi_refgs.cli.command import Parser, Result, UnusableError, finite, prepare
from mi_refgs.errors import InputError
from mi_refgs.runs.interrupt import TerminatedError

EXIT_UNUSABLE, EXIT_BAD_INPUT, EXIT_INTERRUPTED, EXIT_TERMINATED = 1, 2, 130, 143
"""The last two are what shells report for a program that a signal ended: 128 + SIGINT, 128 + SIGTERM."""


def build_parser() -> Parser:
    """The parser of `refgs` with all its commands."""
    parser = Parser(
        prog="refgs", description="Pictures of a shiny object in, a relightable Mitsuba scene of surfels out."
    )
    parser.add_argument("--version", action="version", version=f"mi_refgs {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True, parser_class=Parser)
    for module in (
        doctor,
        demo,
        capture,
        dataset,
        train,
        evaluate,
        compare,
        render,
        relight,
        edit,
        export,
        import_splats,
        profile,
        view,
        completion,
    ):
        module.add(commands)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command and return its exit code; `--help` and `--version` raise SystemExit."""
    try:
        args = build_parser().parse_args(argv)
        with _standard_output_to_error():
            prepare(args)
            result: Result = args.run(args)
    except InputError as error:
        return _failed(str(error), EXIT_BAD_INPUT)
    except UnusableError as error:
        return _failed(str(error), EXIT_UNUSABLE)
    except TerminatedError as error:
        return _failed(str(error) or "terminated", EXIT_TERMINATED)
    except KeyboardInterrupt as error:
        return _failed(str(error) or "interrupted", EXIT_INTERRUPTED)
    print(json.dumps(finite(result.data), allow_nan=False) if args.json else result.text)
    return result.code


def _failed(message: str, code: int) -> int:
    print(f"refgs: {message}", file=sys.stderr)
    return code


@contextlib.contextmanager
def _standard_output_to_error() -> Iterator[None]:
    """Send what libraries print to standard output to standard error, Mitsuba's C++ logger included.

    Only the result of a command goes to standard output, so that `--json` can be piped.
    """
    sys.stdout.flush()
    saved = os.dup(1)
    try:
        os.dup2(2, 1)
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        os.dup2(saved, 1)
        os.close(saved)
