"""`refgs profile`: where the time of a training step and of a picture goes, and what would help."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, add_settings, say
from mi_refgs.constants import DEFAULT_PRESET
from mi_refgs.errors import InputError

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.profiling.profile import FrameProfile, Profile

DEFAULT_STEPS = 15
MOST_STEPS = 1000
MOST_PIXELS = 4096
MEBIBYTE = 2**20


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "say where the time of a training step and of a picture goes, and what would help"
    parser = add_command(commands, "profile", summary, "refgs profile runs/glossy", run)
    parser.add_argument(
        "path",
        type=Path,
        metavar="RUN|DATA",
        help="run folder (its newest checkpoint, in its stage; and its pictures) or data set (a fresh fit, "
        "every stage)",
    )
    parser.add_argument("--data", type=Path, metavar="DATA", help="with RUN: its data set, if it has moved")
    parser.add_argument("--variant", metavar="V", help="with DATA: method (default: the full one)")
    parser.add_argument("--preset", metavar="P", help=f"with DATA: preset (default {DEFAULT_PRESET})")
    parser.add_argument(
        "--steps",
        type=int,
        default=DEFAULT_STEPS,
        metavar="N",
        help=f"steps to measure (default {DEFAULT_STEPS})",
    )
    parser.add_argument(
        "--size",
        type=int,
        nargs="+",
        metavar="N",
        help="with RUN: pixels along the longer side of its pictures (default 200 400 800)",
    )
    add_settings(parser)


def run(args: argparse.Namespace) -> Result:
    """Measure, and advise. Nothing is written."""
    from mi_refgs.profiling.advice import advice
    from mi_refgs.profiling.profile import profile
    from mi_refgs.runs.run import Run
    from mi_refgs.runs.trained_scene import MODEL

    if not 1 <= args.steps <= MOST_STEPS:
        raise InputError(f"--steps: {args.steps} is out of range; give 1 to {MOST_STEPS}")
    for size in args.size or ():
        if not 1 <= size <= MOST_PIXELS:
            raise InputError(f"--size: {size} is out of range; give 1 to {MOST_PIXELS}")
    folder = Run(args.path)
    trained = folder.exists() and not folder.checkpoints() and (args.path / MODEL).is_file()
    # What is refused is refused before the images, which take longest.
    made = None if trained else _trainer(args)
    frames = _frames(args)
    data: dict[str, Any] = {"frames": [asdict(frame) for frame in frames], "threads": _threads()}
    if made is None:
        return Result(data, frames_text(frames))
    trainer, stages = made
    found = profile(trainer, stages, args.steps)
    said = advice(found, trainer.method)
    data |= asdict(found) | {"advice": said}
    data["work"]["share"] = found.work.share
    return Result(data, "\n\n".join([text(found, said), *([frames_text(frames)] if frames else [])]))


def _frames(args: argparse.Namespace) -> list[FrameProfile]:
    """Pictures of a run at each size; none of a data set, or of a run that has found nothing yet."""
    from mi_refgs.profiling.profile import SIZES, aovs_of, profile_frame
    from mi_refgs.reconstruction.reconstruction import load
    from mi_refgs.runs.run import Run
    from mi_refgs.runs.trained_scene import MODEL

    folder = Run(args.path)
    if not folder.exists():
        if args.size:
            raise InputError(f"--size: {args.path} is no run; drop --size")
        return []
    if not folder.checkpoints() and not (args.path / MODEL).is_file():
        return []
    found = load(args.path, write=False)
    draw, camera = found.trained.drawn(), found.camera(0)
    names = aovs_of(draw(camera, True))
    return [profile_frame(draw, names, camera.resized(size)) for size in args.size or SIZES]


def _trainer(args: argparse.Namespace) -> tuple[Trainer, list[str]]:
    """The trainer of a run or of a fresh fit, and the stages of the schedule to look at."""
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.fitting.plan import sized
    from mi_refgs.fitting.runner import load_method
    from mi_refgs.fitting.targets import read_views
    from mi_refgs.fitting.train import Trainer
    from mi_refgs.runs.run import Run

    if not args.path.is_dir():
        raise InputError(f"{args.path}: RUN|DATA: no such folder; give a run folder or a data set")
    folder = Run(args.path)
    if folder.exists():
        for option, value in (("--variant", args.variant), ("--preset", args.preset), ("--set", args.set)):
            if value:
                raise InputError(f"{option}: {args.path} is a run and keeps its method; drop {option}")
        method = folder.method()
        if not folder.checkpoints():
            raise InputError(f"{args.path}: checkpoints: none yet; train on, or profile its data set")
        trainer = Trainer(method, load_split(folder, method, "train", args.data), folder)
        return trainer, [method.stage_at(max(trainer.iteration, 1))[0]]
    if args.data is not None:
        raise InputError(f"--data: {args.path} is no run; drop --data")
    method = sized(load_method(args.variant, args.preset, args.set), args.path, say)
    views = read_views(method, args.path, "train", truth=False)
    return Trainer(method, views), [name for name, _ in method.stages()]


def _threads() -> int:
    import drjit as dr

    return int(dr.thread_count())


def text(found: Profile, said: list[str]) -> str:
    """The profile as lines of text: a table of milliseconds, counts, and what would help."""
    names = list(dict.fromkeys(name for stage in found.stages for name in stage.phases_ms))
    lines = [_row("a training step, ms", [stage.name for stage in found.stages])]
    for name in names:
        lines.append(_row(f"  {name}", [f"{stage.phases_ms.get(name, 0):.2f}" for stage in found.stages]))
    sums = [sum(stage.phases_ms.values()) for stage in found.stages]
    lines.append(_row("  sum, between barriers", [f"{ms:.2f}" for ms in sums]))
    lines.append(_row("undisturbed step", [f"{stage.step_ms:.2f}" for stage in found.stages]))
    lines.append(_row("kernel launches", [f"{stage.launches:.0f}" for stage in found.stages]))
    lines.append(_row("kernels compiled, warm", [f"{stage.misses}" for stage in found.stages]))
    work = found.work
    counts = [
        ("surfels", f"{work.surfels}"),
        ("pixels", f"{work.pixels:.0f}, {work.covered / work.pixels:.0%} covered"),
        ("surfel-tile pairs", f"{work.pairs:.0f}"),
        ("surfel-pixel evaluations", f"{work.evaluated:.0f}"),
        ("  that contribute", f"{work.contributing:.0f} ({work.share:.0%})"),
        ("layers of a covered pixel", f"{work.contributing / max(work.covered, 1):.1f}"),
        ("surfels in no view", f"{work.unseen_share:.0%}"),
        ("memory of the kernels", f"{found.allocated / MEBIBYTE:.0f} MiB at most"),
    ]
    lines += ["", f"a view, mean of {work.views}", *(f"{name:<28}{value}" for name, value in counts), ""]
    return "\n".join([*lines, *(said or ["Nothing stands out."])])


def frames_text(frames: list[FrameProfile]) -> str:
    """A table of milliseconds: the picture alone, and what each AOV adds to it."""
    lines = [_row("a picture, ms", [f"{frame.width}x{frame.height}" for frame in frames])]
    lines.append(_row("  radiance and alpha", [f"{frame.frame_ms:.1f}" for frame in frames]))
    for name in frames[0].aovs_ms:
        lines.append(_row(f"  {name} adds", [f"{frame.aovs_ms[name]:.1f}" for frame in frames]))
    return "\n".join(lines)


def _row(name: str, cells: list[str]) -> str:
    return f"{name:<28}" + "".join(f"{cell:>12}" for cell in cells)
