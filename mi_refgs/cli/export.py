"""`refgs export`: the files of a run, its own and those of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, add_run, say
from mi_refgs.constants import PRUNE_LIMIT
from mi_refgs.errors import InputError, SceneError

if TYPE_CHECKING:
    from mi_refgs.io.ownership import OutputFolder
    from mi_refgs.runs.run import Run


def add(commands: Any) -> None:
    """Add the command to the parser."""
    from mi_refgs.formats import FORMATS, options_of

    summary = "write a run's surfels.ply, envmap.exr, mesh.ply and scene.xml anew, or files of other programs"
    example = "refgs export runs/glossy --to 3dgs-ply,cameras -o taken_along"
    parser = add_command(commands, "export", summary, example, run)
    add_run(parser)
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="PATH",
        help="folder to write to (default: RUN itself); with --to the file, or the folder of several",
    )
    formats = parser.add_argument_group(
        "formats of other programs", "\n".join(f"{made.name:<14}{made.summary}" for made in FORMATS.values())
    )
    formats.add_argument("--to", metavar="NAME[,NAME…]", help="the formats to write")
    for option in options_of(FORMATS).values():
        flag = f"--{option.name.replace('_', '-')}"
        if option.default is False:
            formats.add_argument(flag, action="store_true", default=None, help=option.help)
        else:
            text = f"{option.help} (default {option.default})"
            formats.add_argument(flag, type=type(option.default), metavar=option.name[0].upper(), help=text)
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="data set of the cameras, if not that of the fit"
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace files in the folder -o that are not this export of RUN, but never those of a run",
    )
    parser.add_argument(
        "--prune",
        action="store_true",
        help="leave out what the training views do not need; exporting again without it writes everything",
    )
    parser.add_argument(
        "--limit",
        type=float,
        metavar="DB",
        help="with --prune: PSNR of every pruned picture against the whole one, at least "
        f"(default {PRUNE_LIMIT:g})",
    )


def run(args: argparse.Namespace) -> Result:
    """Export."""
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.formats import FORMATS, options_of, write
    from mi_refgs.reconstruction.provenance import Provenance
    from mi_refgs.runs.export import export, newest
    from mi_refgs.runs.run import Run
    from mi_refgs.runs.trained_scene import ARTEFACTS, TrainedScene

    if args.limit is not None and not args.prune:
        raise InputError("--limit: limits what --prune drops; add --prune, or leave it out")
    options = {name: getattr(args, name) for name in options_of(FORMATS) if getattr(args, name) is not None}
    if args.to is None and options:
        raise InputError(f"--{next(iter(options)).replace('_', '-')}: belongs to a format; name it with --to")
    if args.to is not None and args.output is None:
        raise InputError("--to: names no place; say with -o which file or folder to write")
    folder = Run(args.run_folder)
    method = folder.method()
    state = folder.load_checkpoint()
    fitted = newest(folder, method) if state is None else TrainedScene.from_state(method, state)
    source = Provenance.of(folder).with_data(args.data)
    if source.data is not None and not source.has_data:
        say(f"note: {source.data} is gone; cameras are around the object, or give its folder with --data")
    shots = source.shots(fitted, "test", "train")
    target = args.output or folder.path
    output = _output(folder, target, args.overwrite)
    if args.to is None:
        output.require_free(ARTEFACTS)
    report: dict[str, Any] = {}
    if args.prune:
        from mi_refgs.evaluation.prune import prune

        if state is None and target.resolve() == folder.path.resolve():
            raise InputError(
                f"{folder.path}: checkpoints: none is left to bring the whole scene back from; write the "
                "pruned one to another folder with -o"
            )
        training, views = (load_split(folder, method, split, args.data) for split in ("train", "test"))
        fitted, report = prune(
            fitted, training, views, PRUNE_LIMIT if args.limit is None else args.limit, say
        )
    if args.to is not None:
        try:
            names = [name.strip() for name in args.to.split(",") if name.strip()]
            written = write(fitted, names, target, shots, options, folder.path, args.overwrite)
        except SceneError as error:
            raise InputError(f"{folder.path}: {error}") from error
        files = [str(path) for paths in written.values() for path in paths]
    else:
        files = [str(path) for path in export(fitted, target, shots[0].camera, output=output)]
    data = {"files": files, "iteration": fitted.iteration, "surfels": fitted.surfels.count}
    if not args.prune:
        return Result(data, "\n".join(files))
    return Result(data | {"pruned": report}, "\n".join([*files, table(report)]))


def _output(run: Run, target: Path, overwrite: bool) -> OutputFolder:
    """The folder of the artefacts of a run; raises InputError for the folder of another run."""
    from mi_refgs.io.ownership import OutputFolder
    from mi_refgs.runs.run import Run

    if target.resolve() == run.path.resolve():
        return run.output
    if Run(target).exists():
        raise InputError(f"{target}: output: holds a run, which is never overwritten; choose another -o")
    remedy = "choose another -o, or replace it with --overwrite"
    return OutputFolder(target, f"export of {run.path.resolve()}", remedy=remedy, overwrite=overwrite)


def table(report: dict[str, Any]) -> str:
    """The report of `evaluation.prune` for people."""
    before, after = report["before"], report["after"]
    lines = [
        f"{'surfels':<22}{before['surfels']} -> {after['surfels']}",
        f"{'surfels.ply':<22}{before['ply_bytes'] / 1e6:.2f} -> {after['ply_bytes'] / 1e6:.2f} MB",
    ]
    for name, columns in before["channels"].items():
        left = after["channels"].get(name, 0)
        if left != columns:
            lines.append(f"{name:<22}{columns} -> {left} columns")
    lines += [f"{name:<22}dropped" for name in ("light", "mesh") if before[name] and not after[name]]
    for split in ("train", "test"):
        if split in report:
            scores = report[split]
            lines.append(
                f"{f'{split} views':<22}worst {scores['worst']:.1f} dB, mean {scores['mean']:.1f} dB "
                f"({scores['views']}), against the whole scene"
            )
    lines.append(f"{'frame':<22}{before['ms_per_frame']:.1f} -> {after['ms_per_frame']:.1f} ms")
    return "\n".join(lines)
