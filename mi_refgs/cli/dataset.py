"""`refgs dataset`: a multi-view data set from a Mitsuba scene."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output

EXAMPLE = "refgs dataset scenes/glossy_demo.xml -o data/glossy --views 80 --size 160 --spp 128"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = (
        "path-trace a multi-view data set of a Mitsuba scene: pictures, materials, shape, light, cameras"
    )
    parser = add_command(commands, "dataset", summary, EXAMPLE, run)
    parser.add_argument(
        "scene", type=Path, metavar="SCENE.xml", help="a Mitsuba scene with an environment emitter, or lamps"
    )
    add_output(parser, "folder of the data set; what an interrupted run left is continued", "DIR")
    parser.add_argument(
        "--views", type=int, default=80, metavar="N", help="training views (default %(default)s)"
    )
    parser.add_argument(
        "--test-views", type=int, metavar="N", help="test views (default: a quarter of --views)"
    )
    parser.add_argument(
        "--size",
        type=_size,
        default=160,
        metavar="S",
        help="pixels a side, or WIDTHxHEIGHT (default %(default)s)",
    )
    parser.add_argument(
        "--object",
        nargs="+",
        default=[],
        metavar="ID",
        help="shapes that an open scene is about: pictures without transparency, truth of these alone",
    )
    parser.add_argument(
        "--distance",
        type=float,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="cameras from the object's centre, scene units (default: as far as to show it whole)",
    )
    parser.add_argument(
        "--colmap", type=Path, metavar="DIR", help="write the same as COLMAP's text files, too, with points"
    )
    parser.add_argument(
        "--spp", type=int, default=128, metavar="N", help="samples per pixel (default %(default)s)"
    )
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="of cameras and paths (default %(default)s)"
    )
    parser.add_argument(
        "--max-depth", type=int, default=6, metavar="N", help="longest path (default %(default)s)"
    )
    parser.add_argument(
        "--elevation",
        type=float,
        nargs=2,
        default=(-30.0, 80.0),
        metavar=("LOW", "HIGH"),
        help="camera heights, degrees",
    )
    parser.add_argument(
        "--fov",
        type=float,
        default=40.0,
        metavar="DEG",
        help="field of view of the shorter side (default %(default)s)",
    )
    parser.add_argument(
        "--light",
        type=Path,
        metavar="ENV",
        help="a lat-long map (EXR, HDR) in place of the scene's environment",
    )
    parser.add_argument(
        "--relight",
        type=Path,
        nargs="+",
        default=[],
        metavar="ENV",
        help="trace the test views under these maps, too, into relight/NAME; also later",
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="replace a data set that was made with other settings"
    )


def _size(text: str) -> int | tuple[int, int]:
    """Pixels a side, or width and height."""
    parts = text.lower().split("x")
    if len(parts) > 2 or not all(part.isdecimal() and int(part) for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}: give pixels a side, or WIDTHxHEIGHT")
    numbers = [int(part) for part in parts]
    return numbers[0] if len(parts) == 1 else (numbers[0], numbers[1])


def run(args: argparse.Namespace) -> Result:
    """Trace the views."""
    from mi_refgs.synthesis.make_dataset import make_dataset

    folder = make_dataset(
        args.scene,
        args.output,
        views=args.views,
        size=args.size,
        spp=args.spp,
        seed=args.seed,
        test_views=args.test_views,
        max_depth=args.max_depth,
        elevation=tuple(args.elevation),
        fov=args.fov,
        light=args.light,
        relight=args.relight,
        objects=args.object,
        distance=args.distance,
        colmap=args.colmap,
        overwrite=args.overwrite,
    )
    counts = {split: len(list((folder / split).glob("r_*.png"))) for split in ("train", "test")}
    lights = sorted(path.parent.name for path in folder.glob("relight/*/transforms_test.json"))
    text = (
        f"{folder}: {counts['train']} training and {counts['test']} test views"
        f"{', these also under ' if lights else ''}{', '.join(lights)}; "
        f"next: refgs train {folder} -o runs/{folder.name}"
    )
    return Result(
        {
            "dataset": str(folder),
            "train_views": counts["train"],
            "test_views": counts["test"],
            "size": args.size,
            "relight": lights,
        },
        text,
    )
