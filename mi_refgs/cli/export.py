"""`refgs export`: the files of a run that other programs read."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "write surfels.ply, envmap.exr, mesh.ply and scene.xml from the newest checkpoint of a run"
    parser = add_command(commands, "export", summary, "refgs export runs/glossy -o glossy_scene", run)
    parser.add_argument("run_folder", type=Path, metavar="RUN", help="run folder that `refgs train` wrote")
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder to write to (default: RUN itself)"
    )
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="data set whose first test camera scene.xml gets"
    )


def run(args: argparse.Namespace) -> Result:
    """Export."""
    from mi_refgs.errors import InputError
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.runs.export import TrainedScene, export
    from mi_refgs.runs.run import Run

    folder = Run(args.run_folder)
    method = folder.method()
    camera = load_split(folder, method, "test", args.data).views[0].camera()
    state = folder.load_checkpoint()
    fitted = TrainedScene.read(folder.path) if state is None else TrainedScene.from_state(method, state)
    target = args.output or folder.path
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{target}: output: cannot be created ({error.strerror}); choose a writable folder with -o"
        ) from error
    files = [str(path) for path in export(fitted, target, camera)]
    data = {"files": files, "iteration": fitted.iteration, "surfels": fitted.surfels.count}
    return Result(data, "\n".join(files))
