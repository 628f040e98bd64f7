"""`refgs edit`: other materials, colours and places of things; cut, duplicated, joined with another run."""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output, add_run, say
from mi_refgs.errors import InputError

EXAMPLE = 'refgs edit runs/glossy -o runs/matte --set roughness=0.6 --where "metallic > 0.5" --preview'

OPTIONS = (
    *("where", "box", "nearest", "mask", "view", "split", "invert", "materials"),
    *("set", "scale", "rotate", "move", "duplicate", "cut", "keep"),
)
"""Options that are keywords of `Reconstruction.edit`."""
PREVIEW = "preview.png"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "write a new run with some surfels changed, cut, moved, duplicated, or with another run added"
    parser = add_command(commands, "edit", summary, EXAMPLE, run)
    # As newer versions of argparse have it: -1e-3 and -1,0,0 are no options either.
    parser._negative_number_matcher = re.compile(r"-\.?\d")
    add_run(parser)
    add_output(parser, "new run folder", "NEW")
    chosen = parser.add_argument_group("which surfels (those that meet all of it; default: all)")
    chosen.add_argument(
        "--where",
        metavar="EXPRESSION",
        help='such as "metallic > 0.5 and z < 0"; a wrong name lists what there is',
    )
    chosen.add_argument(
        "--box", nargs=6, type=float, metavar=("X0", "Y0", "Z0", "X1", "Y1", "Z1"), help="inside of it"
    )
    chosen.add_argument(
        "--nearest",
        nargs=4,
        type=float,
        metavar=("X", "Y", "Z", "R"),
        help="within R of the surfel that is nearest to the point",
    )
    chosen.add_argument(
        "--mask", type=Path, metavar="PNG", help="what a picture of a view shows where it is painted white"
    )
    chosen.add_argument(
        "--view",
        type=view,
        default=0,
        metavar="I|CAMERA.json",
        help="the view of --mask: a number, or what the page of `refgs view` saved (default %(default)s)",
    )
    chosen.add_argument(
        "--split", choices=("test", "train"), default="test", help="whose views these are (default test)"
    )
    chosen.add_argument("--invert", action="store_true", help="all others instead")
    done = parser.add_argument_group("what is done (in this order)")
    done.add_argument(
        "--materials",
        action="store_true",
        help="first make materials alone of the run, so that nothing stays as fitted to its light",
    )
    done.add_argument(
        "--set",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help='such as roughness=0.3 albedo=0.9,0.6,0.2 opacity*=0.5 "metallic=max(metallic, 0.5)"; '
        "colour=R,G,B is that of methods with fitted colours",
    )
    done.add_argument("--scale", type=float, default=1.0, metavar="F", help="larger, about its middle")
    done.add_argument(
        "--rotate",
        nargs=2,
        metavar=("AXIS", "DEG"),
        help="turned about its middle and the axis x, y, z or X,Y,Z, counter-clockwise",
    )
    done.add_argument("--move", nargs=3, type=float, metavar=("X", "Y", "Z"), help="moved, scene units")
    done.add_argument(
        "--duplicate",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="do it to a copy that is moved so far; what was there stays",
    )
    cuts = done.add_mutually_exclusive_group()
    cuts.add_argument("--cut", action="store_true", help="remove it")
    cuts.add_argument("--keep", action="store_true", help="remove everything else")
    done.add_argument(
        "--join",
        type=Path,
        metavar="OTHER",
        help="add run OTHER, under the light of RUN; what is selected and done is then of OTHER",
    )
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="data set of the views, if not that of the fit"
    )
    parser.add_argument("--preview", action="store_true", help="preview.png: views before and after")


def view(text: str) -> int | Path:
    """The number of a view, or the file of a camera."""
    return int(text) if re.fullmatch(r"-?\d{1,9}", text, re.ASCII) else Path(text)


def run(args: argparse.Namespace) -> Result:
    """Edit."""
    from mi_refgs.editing import assignments
    from mi_refgs.editing.expression import parse_condition
    from mi_refgs.formats.cameras import read_cameras
    from mi_refgs.io.images import write_png
    from mi_refgs.reconstruction.reconstruction import load
    from mi_refgs.runs.run import Run

    _require_free(args.output)
    assignments(args.set)  # what is no formula is said before the run is read, which takes seconds
    if args.where is not None:
        parse_condition(args.where)
    whole = load(args.run_folder, write=False)
    whole = replace(whole, provenance=whole.provenance.with_data(args.data))
    join = None if args.join is None else load(args.join, write=False)
    options = {name: getattr(args, name) for name in OPTIONS}
    if isinstance(args.view, Path):
        options["view"] = read_cameras(args.view)[0]
    try:
        edited = whole.edit(**options, join=join)
    except InputError as error:
        runs = " + ".join(str(path) for path in (args.run_folder, args.join) if path is not None)
        raise InputError(f"{runs}: {error}") from error
    entry = edited.provenance.edits[-1]
    for note in entry["notes"]:
        say(f"note: {note}")
    sheet = _preview(whole, edited) if args.preview else None
    edited.save(args.output)
    if sheet is not None:
        write_png(Run(args.output).output.own(PREVIEW), sheet)
    text = f"{args.output}: {entry['selected']} of {entry['of']} surfels; it has {entry['surfels']}"
    return Result({"output": str(args.output), **entry}, text)


def _preview(before: Any, after: Any) -> Any:
    """Test views before and after; of cameras around the object where the data set is not there."""
    from mi_refgs.editing import before_and_after

    cameras = before.cameras()
    if not before.provenance.has_data:
        return before_and_after(before.trained, after.trained, cameras)
    views = before.views()
    return before_and_after(
        before.trained, after.trained, cameras, views.background, views.is_linear_radiance
    )


def _require_free(out: Path) -> None:
    """Raise InputError unless a folder can be made there: nothing stands there, or an empty one."""
    from mi_refgs.io.files import cannot_write

    try:
        taken = os.path.lexists(out) and not (out.is_dir() and not any(out.iterdir()))
    except (OSError, ValueError) as error:
        raise cannot_write(out, error) from error
    if taken:
        raise InputError(f"{out}: output: stands there already; choose another -o")
