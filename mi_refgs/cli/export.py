"""`refgs export`: the files of a run that other programs read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_run, say
from mi_refgs.errors import InputError


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "write surfels.ply, envmap.exr, mesh.ply and scene.xml from the newest checkpoint of a run"
    parser = add_command(commands, "export", summary, "refgs export runs/glossy -o glossy_scene --prune", run)
    add_run(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder to write to (default: RUN itself)"
    )
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="data set of the cameras, if not that of the fit"
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
        help="with --prune: PSNR of every pruned picture against the whole one, at least (default 50)",
    )


def run(args: argparse.Namespace) -> Result:
    """Export."""
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.runs.export import TrainedScene, export
    from mi_refgs.runs.run import Run

    if args.limit is not None and not args.prune:
        raise InputError("--limit: limits what --prune drops; add --prune, or leave it out")
    folder = Run(args.run_folder)
    method = folder.method()
    views = load_split(folder, method, "test", args.data)
    state = folder.load_checkpoint()
    fitted = TrainedScene.read(folder.path) if state is None else TrainedScene.from_state(method, state)
    target = args.output or folder.path
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{target}: output: cannot be created ({error.strerror}); choose a writable folder with -o"
        ) from error
    report: dict[str, Any] = {}
    if args.prune:
        from mi_refgs.evaluation.prune import LIMIT, prune

        if state is None and target.resolve() == folder.path.resolve():
            raise InputError(
                f"{folder.path}: checkpoints: none is left to bring the whole scene back from; write the "
                "pruned one to another folder with -o"
            )
        training = load_split(folder, method, "train", args.data)
        limit = LIMIT if args.limit is None else args.limit
        fitted, report = prune(fitted, training, views, limit, say)
    files = [str(path) for path in export(fitted, target, views.views[0].camera())]
    data = {"files": files, "iteration": fitted.iteration, "surfels": fitted.surfels.count}
    if not args.prune:
        return Result(data, "\n".join(files))
    return Result(data | {"pruned": report}, "\n".join([*files, table(report)]))


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
