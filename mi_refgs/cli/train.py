"""`refgs train`: fits surfels, materials and light to a data set."""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, add_output, add_settings, say, warn
from mi_refgs.cli.progress import Progress
from mi_refgs.errors import InputError
from mi_refgs.resources import resource_dir

if TYPE_CHECKING:
    from mi_refgs.fitting.plan import Estimate
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.methods.method import Method
    from mi_refgs.runs.run import Run

DEFAULT_METHOD = "ref_gaussian.toml"
"""File of `variants/` that is fitted when none is named: the full method."""
OPEN_PURPOSE = "photographs"
"""What the method that is fitted to pictures without alpha is for, when none is named."""
DEFAULT_PRESET = "standard"

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


def run(args: argparse.Namespace) -> Result:
    """Fit, from the start or from the newest checkpoint."""
    variant = variant_of(args.variant, args.purpose)
    begin = time.monotonic()
    trainer, expected = fit(args.data, args.output, variant, args.preset, args.set, args.resume, args.minutes)
    taken = time.monotonic() - begin
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


def variant_of(variant: str | None, purpose: str | None) -> str | None:
    """The method that one of the two options names; raises InputError for both or an unknown purpose."""
    from mi_refgs import methods

    if purpose is None:
        return variant
    if variant is not None:
        raise InputError(f"--for: {purpose}: --variant {variant} names a method already; give one of the two")
    return methods.for_purpose(purpose)


def default_variant(
    data_path: Path, preset: str | None = None, assignments: list[str] | None = None
) -> str | None:
    """The method for pictures without alpha, where the data set has such; None for the full one."""
    from mi_refgs import methods
    from mi_refgs.data.picture_store import undecoded
    from mi_refgs.fitting.whole import read_views

    # What `assignments` say of a method may be of the other one.
    of_data = [text for text in assignments or [] if text.startswith("data.")]
    with undecoded():
        views = read_views(load_method(None, preset, of_data), data_path, "train", truth=False)
    if views.cut_out or views.region is None:
        return None
    variant = methods.for_purpose(OPEN_PURPOSE)
    say(f"{data_path}: pictures without alpha: --variant {variant} fits their surroundings too")
    return variant


def load_method(variant: str | None, preset: str | None, assignments: list[str] | None) -> Method:
    """The method of the options, or the full one at the preset for everyday use."""
    from mi_refgs import methods

    path = variant or str(resource_dir("variants") / DEFAULT_METHOD)
    return methods.load(path, preset or DEFAULT_PRESET, assignments)


def _compared(taken: float, expected: Estimate | None) -> str:
    """All of the time of a fit beside its estimate, for people."""
    from mi_refgs.fitting.plan import minutes

    return "" if expected is None else f" ({minutes(taken)} in all, estimate {minutes(expected.seconds)})"


def fit(
    data_path: Path,
    output: Path,
    variant: str | None = None,
    preset: str | None = None,
    assignments: list[str] | None = None,
    resume: bool = False,
    limit: float | None = None,
) -> tuple[Trainer, Estimate | None]:
    """Train with a progress bar and previews, then write the artefacts; a finished run is only loaded.

    `limit` is the time in minutes that the fit may take. Returns the estimate of a new fit, too.

    Raises InputError for bad input, and KeyboardInterrupt or TerminatedError with a message that says how to
    go on.
    """
    from mi_refgs.fitting.plan import planned
    from mi_refgs.fitting.whole import begin, finish, read_views
    from mi_refgs.runs.run import Run

    expected: Estimate | None = None
    folder = Run(output)
    resumed = resume and folder.exists()
    if resumed:
        method = folder.method()
        _require_same(folder, method, data_path, variant, preset, assignments)
    else:
        folder.require_none()
        if limit is not None and not 0 < limit < math.inf:
            raise InputError(f"--minutes: {limit} is no time; give more than 0")
        variant = variant or default_variant(data_path, preset, assignments)
        wanted = None if limit is None else 60 * limit
        method, expected = planned(load_method(variant, preset, assignments), data_path, wanted, say)
        if expected is not None:
            say(expected.sentence(method.iterations))
    views = read_views(method, data_path, "train", truth=False)
    warn_of_data(method, views)
    trainer = begin(method, views, folder, say)
    if resumed:
        say(f"{output}: resumed at iteration {trainer.iteration} of {method.iterations}")

    try:
        with Progress(trainer, folder) as progress:
            trainer.train(progress)
    except KeyboardInterrupt as error:
        kept = "" if folder.checkpoints() else " (before the first iteration was done)"
        raise type(error)(
            f"interrupted at iteration {trainer.iteration}{kept}; "
            f"resume with: refgs train {data_path} -o {output} --resume"
        ) from None
    except InputError as error:  # a full disk, no surfel left
        saved = folder.checkpoints()
        kept = f" (saved up to iteration {int(saved[-1].stem)}; --resume goes on from there)" if saved else ""
        raise InputError(f"{error}{kept}") from error
    if warning := finish(trainer, folder):
        warn(warning)
    warn_of_outcome(trainer)
    return trainer, expected


def _require_same(
    folder: Run,
    method: Method,
    data_path: Path,
    variant: str | None,
    preset: str | None,
    assignments: list[str] | None,
) -> None:
    """Raise InputError if a run that is resumed was started with something else."""
    if assignments:
        raise InputError(
            f"--set: {assignments[0]}: a resumed run keeps its method; drop --set or choose another -o"
        )
    for option, wanted, found in (
        ("--variant", variant and Path(variant).stem, method.variant),
        ("--preset", preset, method.preset),
    ):
        if wanted and wanted != found:
            raise InputError(
                f"{folder.path / 'config.toml'}: {option}: the run was started with '{found}', "
                f"not '{wanted}'; drop {option} or choose another -o"
            )
    try:
        before = folder.dataset()
    except (OSError, ValueError, KeyError, TypeError):
        before = data_path.resolve()
    if before.resolve() != data_path.resolve():
        warn(f"{folder.path}: was fitted to {before} before, now to {data_path}")


def warn_of_data(method: Method, views: Any) -> None:
    """Say what is unusual about a data set."""
    from mi_refgs.data.survey import few_views

    if note := few_views(len(views.views)):
        warn(f"{views.path}: {note}")
    if not views.cut_out and (method.surroundings is None or views.region is None):
        warn(
            f"{views.path}: pictures without alpha: surfels start at random, "
            "and the background becomes surfels too"
        )


def warn_of_outcome(trainer: Trainer) -> None:
    """Say what is unusual about a finished fit."""
    options, count = trainer.method.surfels, trainer.surfels.count
    if trainer.method.refine.densify is not None and count >= options.max_count:
        warn(f"all {count} surfels in use; more may help: --set surfels.max_count={2 * options.max_count}")
    if count < options.count // 10:
        warn(f"{count} of {options.count} surfels are left; look at the previews")
