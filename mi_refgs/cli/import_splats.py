"""`refgs import`: a run folder of a PLY file that another program has written."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output
from mi_refgs.errors import counted


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "make a run folder of a PLY file of 3DGS or 2DGS, which render, view, edit and export read"
    parser = add_command(commands, "import", summary, "refgs import point_cloud.ply -o runs/theirs", run)
    parser.add_argument("file", type=Path, metavar="FILE.ply", help="3D Gaussians or surfels of any degree")
    add_output(parser, "run folder to write; one that holds a run is refused", "RUN")
    parser.add_argument(
        "--transforms",
        type=Path,
        metavar="FILE.json",
        help="cameras for scene.xml (default: cameras around the object, z up)",
    )
    parser.add_argument(
        "--linear",
        action="store_true",
        help="colours are linear radiance, as this program fits them (default: display-encoded)",
    )


def run(args: argparse.Namespace) -> Result:
    """Import."""
    from mi_refgs.formats.cameras import read_cameras
    from mi_refgs.reconstruction.reconstruction import import_splats
    from mi_refgs.runs.export import save
    from mi_refgs.runs.run import Run

    Run(args.output).require_none()
    made = import_splats(args.file, linear=args.linear)
    cameras = made.cameras() if args.transforms is None else read_cameras(args.transforms)
    written = save(made.trained, args.output, made.method, cameras[0], more=cameras[1:])
    files = [str(path) for path in written]
    surfels = made.trained.surfels
    kind, degree = surfels.primitive.name, surfels.sh_degree()
    data = {"files": files, "surfels": surfels.count, "primitive": kind, "degree": degree}
    data["cameras"] = len(cameras)
    what = (
        f"{counted(surfels.count, kind)} of degree {degree}, {counted(len(cameras), 'camera')} in scene.xml"
    )
    return Result(data, f"{args.output}: {what}")
