"""`refgs relight`: a trained scene under another light."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_run, add_test_views, warn

EXAMPLE = "refgs relight runs/glossy --envmap studio.hdr --rotate 90 -o relit/studio"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "show a run under another light: pictures, scene.xml, and the score where the truth is known"
    parser = add_command(commands, "relight", summary, EXAMPLE, run)
    add_run(parser)
    parser.add_argument(
        "--envmap",
        type=Path,
        required=True,
        metavar="FILE",
        help="lat-long map (EXR, HDR), its first row straight up, along +z",
    )
    parser.add_argument(
        "--world",
        action="store_true",
        help="the map is in world directions already, as an environment.exr or envmap.exr is",
    )
    parser.add_argument(
        "--rotate",
        type=float,
        default=0.0,
        metavar="DEG",
        help="turn the light about +z, which is up, counter-clockwise seen from above",
    )
    parser.add_argument(
        "--exposure", type=float, default=0.0, metavar="EV", help="stops by which the light is brighter"
    )
    parser.add_argument(
        "--turntable", type=int, default=0, metavar="N", help="N views around the object, not the test views"
    )
    add_test_views(parser)
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder for it all (default: RUN/relight/NAME)"
    )


def run(args: argparse.Namespace) -> Result:
    """Relight."""
    from mi_refgs.reconstruction.new_light import NewLight
    from mi_refgs.relighting.relight import SHEET, relight
    from mi_refgs.runs.run import Run

    light = NewLight(args.envmap, args.world, args.rotate, args.exposure)
    relit = relight(
        Run(args.run_folder),
        light,
        args.output,
        turntable=args.turntable,
        data=args.data,
        samples=args.samples,
        progress=True,
    )
    if relit.warning:
        warn(relit.warning)
    result = relit.result
    lines = [f"{len(result['pictures'])} pictures, scene.xml and {SHEET} in {result['output']}"]
    if result["psnr"] is None:
        lines.append(f"score: none: {result['score_reason']}")
    else:
        factors = ", ".join(f"{x:.3f}" for x in result["scale"])
        lines.append(f"PSNR                       {result['psnr']:.2f} dB")
        lines.append(f"PSNR, one scale a channel  {result['psnr_scaled']:.2f} dB  (scale {factors})")
    return Result(result, "\n".join(lines))
