"""`refgs train`: fits surfels, materials and light to a data set."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, add_output, add_settings
from mi_refgs.cli.view import HOST, PORT
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError

if TYPE_CHECKING:
    from mi_refgs.fitting.plan import Estimate
    from mi_refgs.reconstruction.fit import ProgressBar

EXAMPLE = "refgs train data/glossy -o runs/glossy --preset quick --set loss.alpha=0.1"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "fit surfels with materials and a light to pictures"
    parser = add_command(commands, "train", summary, EXAMPLE, run)
    parser.add_argument("data", type=Path, metavar="DATA", help="data set: a folder of pictures with cameras")
    add_output(parser, "run folder", "RUN")
    parser.add_argument("--variant", metavar="V", help="method: a name or a .toml (default: the full method)")
    parser.add_argument(
        "--for", dest="purpose", metavar="PURPOSE", help="the method for a purpose, such as relighting"
    )
    parser.add_argument(
        "--preset", metavar="P", help=f"quick, standard or paper: how long (default {DEFAULT_PRESET})"
    )
    parser.add_argument(
        "--minutes", type=float, metavar="M", help="time that the fit may take, by smaller or larger pictures"
    )
    add_settings(parser)
    parser.add_argument(
        "--resume", action="store_true", help="go on from the newest checkpoint, if there is one"
    )
    parser.add_argument(
        "--view",
        nargs="?",
        type=int,
        const=PORT,
        metavar="PORT",
        help=f"show pictures and curves of the fit in the browser (default port {PORT})",
    )


def run(args: argparse.Namespace) -> Result:
    """Fit, from the start or from the newest checkpoint."""
    from mi_refgs.reconstruction.fit import ProgressBar, fit

    progress, begin = ProgressBar() if args.view is None else _watched(args.view), time.monotonic()
    fit(
        args.data,
        variant_of(args.variant, args.purpose),
        preset=args.preset,
        minutes=args.minutes,
        settings=args.set,
        output=args.output,
        resume=args.resume,
        progress=progress,
    )
    taken = time.monotonic() - begin
    trainer, expected = progress.trainer, progress.expected
    assert trainer is not None
    last = trainer.statistics() if trainer.loss is not None else {}
    data = {
        "run": str(args.output),
        "variant": trainer.method.variant,
        "preset": trainer.method.preset,
        "iterations": trainer.iteration,
        "seconds": round(trainer.seconds, 3),
        "total_seconds": round(taken, 3),
        "estimated_seconds": None if expected is None else round(expected.seconds, 3),
        "surfels": trainer.surfels.count,
        "loss": last.get("loss"),
    }
    text = (
        f"{args.output}: {trainer.iteration} iterations in {trainer.seconds:.0f} s"
        f"{_compared(taken, expected)}, "
        f"{trainer.surfels.count} surfels; next: refgs eval {args.output}"
    )
    if trainer.decisions:
        from mi_refgs.fitting.select import table

        data |= {"terms": list(trainer.method.terms), "decisions": trainer.decisions}
        text = f"{table(trainer.decisions)}\n{text}"
    return Result(data, text)


def _watched(port: int) -> ProgressBar:
    """The bar of a fit with a page; raises InputError as `refgs view` does."""
    from mi_refgs.viewer.training import TrainingViewer

    return TrainingViewer(HOST, port)


def variant_of(variant: str | None, purpose: str | None) -> str | None:
    """The method that one of the two options names; raises InputError for both or an unknown purpose."""
    from mi_refgs import methods

    if purpose is None:
        return variant
    if variant is not None:
        raise InputError(f"--for: {purpose}: --variant {variant} names a method already; give one of the two")
    return methods.for_purpose(purpose)


def _compared(taken: float, expected: Estimate | None) -> str:
    """All of the time of a fit beside its estimate, for people."""
    from mi_refgs.fitting.plan import minutes

    return "" if expected is None else f" ({minutes(taken)} in all, estimate {minutes(expected.seconds)})"
