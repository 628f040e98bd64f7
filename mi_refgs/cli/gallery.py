"""`refgs gallery`: pictures of what the package finds of its own scenes."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output, add_settings, say


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = (
        "fit the scenes of the package, and make a page of turntables, materials, relit and edited pictures"
    )
    parser = add_command(commands, "gallery", summary, "refgs gallery -o gallery --scenes mirror_ring", run)
    add_output(parser, "folder of the page; run again, it goes on where it stopped", "DIR")
    parser.add_argument(
        "--scenes", nargs="+", default=[], metavar="NAME", help="some of the scenes (default: all)"
    )
    parser.add_argument(
        "--work",
        type=Path,
        default=Path("runs/gallery"),
        metavar="FOLDER",
        help="where data sets and runs go (default %(default)s)",
    )
    parser.add_argument(
        "--views", type=int, default=100, metavar="N", help="training views of a scene (default %(default)s)"
    )
    parser.add_argument(
        "--size", type=int, default=200, metavar="S", help="pixels a side (default %(default)s)"
    )
    parser.add_argument(
        "--preset", default="standard", metavar="P", help="how long to fit (default %(default)s)"
    )
    add_settings(parser)


def run(args: argparse.Namespace) -> Result:
    """Make what is missing."""
    from mi_refgs.gallery import make_gallery

    found = make_gallery(
        args.output,
        args.work,
        args.scenes,
        views=args.views,
        size=args.size,
        preset=args.preset,
        assignments=args.set,
        progress=True,
        tell=say,
    )
    files = sorted(path for path in args.output.rglob("*") if path.is_file())
    size = sum(path.stat().st_size for path in files)
    text = (
        f"{args.output / 'README.md'}: {len(found['scenes'])} scenes, {len(files)} files, {size / 1e6:.1f} MB"
    )
    return Result({"output": str(args.output), "bytes": size, **found}, text)
