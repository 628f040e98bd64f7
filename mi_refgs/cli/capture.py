"""`refgs capture`: a data set with cameras from a folder of photographs."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output, say

EXAMPLE = "refgs capture holiday/vase -o data/vase"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "find the cameras of a folder of photographs, and make a data set of them"
    parser = add_command(commands, "capture", summary, EXAMPLE, run, kernels=False)
    parser.add_argument(
        "photographs", type=Path, metavar="PHOTOS", help="folder with JPEG or PNG files of one scene"
    )
    add_output(parser, "folder of the data set; what an interrupted run left is continued", "DATA")
    parser.add_argument(
        "--masks",
        type=Path,
        metavar="FOLDER",
        help="a mask for each photograph, NAME.png, white where the object is",
    )
    parser.add_argument(
        "--camera",
        metavar="MODEL",
        help="COLMAP's model of the lens, such as OPENCV or OPENCV_FISHEYE (default: the simplest that fits)",
    )
    parser.add_argument(
        "--region",
        type=float,
        nargs=4,
        metavar=("X", "Y", "Z", "R"),
        help="centre and radius of what matters, read off capture.png (default: what the cameras look at)",
    )


def run(args: argparse.Namespace) -> Result:
    """Place the photographs."""
    from mi_refgs.capture.pipeline import capture
    from mi_refgs.data.region import Region

    region = None
    if args.region is not None:
        *centre, radius = args.region
        region = Region.of({"centre": centre, "radius": radius}, "--region")
    report = capture(
        args.photographs, args.output, masks=args.masks, camera=args.camera, region=region, tell=say
    )
    return Result({"dataset": str(args.output), **report.content}, report.text(args.output))
