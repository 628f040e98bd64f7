"""What commands share: the parser's manners, common options, results, warnings, and setting Mitsuba up."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from mi_refgs import llvm
from mi_refgs.errors import InputError
from mi_refgs.progress import say as say
from mi_refgs.progress import warn as warn

DEFAULT_VARIANT = "llvm_ad_rgb"


@dataclass(frozen=True)
class Result:
    """What a command found: `data` for `--json`, `text` for people."""

    data: dict[str, Any]
    text: str
    code: int = 0


class UnusableError(Exception):
    """This installation cannot run the command; the message says what to install."""


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are InputErrors of one sentence."""

    def error(self, message: str) -> NoReturn:
        """Raise what `main` prints; argparse would print its usage and exit."""
        command = self.prog.removeprefix("refgs").strip()
        raise InputError(f"{command}{': ' if command else ''}{message}; see `{self.prog} --help`")


def add_command(
    commands: Any,
    name: str,
    summary: str,
    example: str,
    run: Callable[[argparse.Namespace], Result],
    *,
    kernels: bool = True,
) -> Parser:
    """Add a command with its help, its example and the options that every command has.

    `kernels` says whether the command needs a Mitsuba variant.
    """
    parser: Parser = commands.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=f"example:\n  {example}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    common = parser.add_argument_group("common options")
    common.add_argument(
        "--json", action="store_true", help="print one JSON object on standard output and nothing else there"
    )
    if kernels:
        common.add_argument(
            "--mitsuba-variant",
            default=DEFAULT_VARIANT,
            metavar="V",
            help=f"Mitsuba variant (default {DEFAULT_VARIANT})",
        )
        common.add_argument(
            "--threads",
            type=int,
            metavar="N",
            help="worker threads (default: every core); with 1, training is reproducible bit for bit",
        )
    parser.set_defaults(run=run, kernels=kernels)
    return parser


def add_output(parser: Parser, what: str, metavar: str) -> None:
    """Add the required option -o."""
    parser.add_argument("-o", "--output", type=Path, required=True, metavar=metavar, help=what)


def add_run(parser: Parser) -> None:
    """Add the run folder."""
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="run folder that `refgs train` wrote")


def add_test_views(parser: Parser) -> None:
    """Add --data and --samples: which test views are rendered, and how."""
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="another data set than the one it was fitted to"
    )
    parser.add_argument(
        "--samples",
        type=int,
        default=1,
        metavar="N",
        help="samples per pixel, box filtered: 4 are 2 × 2; 1 is the pixel's centre, as in training "
        "(default %(default)s)",
    )


def add_settings(parser: Parser) -> None:
    """Add the option --set."""
    parser.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="key=value",
        help="change the method, as in loss.ssim=0.1",
    )


def prepare(args: argparse.Namespace) -> None:
    """Set the number of threads and Mitsuba's variant.

    Raises InputError for a variant that the renderer cannot use, UnusableError where it cannot be started.
    """
    if not args.kernels:
        return
    import drjit as dr
    import mitsuba as mi

    variant = args.mitsuba_variant
    usable = [name for name in mi.variants() if name.endswith("_ad_rgb")]
    if variant not in usable:
        raise InputError(f"--mitsuba-variant: {variant}: cannot be used; give one of {', '.join(usable)}")
    if args.threads is not None:
        if not 1 <= args.threads <= 4 * (os.cpu_count() or 1):
            raise InputError(
                f"--threads: {args.threads} is out of range; give 1 to {4 * (os.cpu_count() or 1)}"
            )
        dr.set_thread_count(args.threads)
    try:
        mi.set_variant(variant)
    except ImportError as error:
        problem = llvm.problem() if variant.startswith("llvm") else None
        raise UnusableError(f"{problem or error} (`refgs doctor` says more)") from error
    mi.set_log_level(mi.LogLevel.Warn)


def finite(value: Any) -> Any:
    """The value with NaN and infinities, which JSON does not have, as null."""
    if isinstance(value, dict):
        return {key: finite(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [finite(inner) for inner in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
