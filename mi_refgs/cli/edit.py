"""`refgs edit`: other materials, colours and places of things; cut, duplicated, joined with another run."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output, add_run, say
from mi_refgs.errors import InputError

EXAMPLE = 'refgs edit runs/glossy -o runs/matte --set roughness=0.6 --where "metallic > 0.5" --preview'

OPTIONS = (
    *("where", "box", "nearest", "invert", "materials"),
    *("set", "scale", "rotate", "move", "duplicate", "cut", "keep"),
)
"""Options that are keywords of `editing.edit` as they are."""


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "write a new run with some surfels changed, cut, moved, duplicated, or with another run added"
    parser = add_command(commands, "edit", summary, EXAMPLE, run)
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
        "--view", type=int, default=0, metavar="I", help="the view of --mask (default %(default)s)"
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


def run(args: argparse.Namespace) -> Result:
    """Edit."""
    from mi_refgs.editing import edit, folder, read_mask
    from mi_refgs.evaluation.evaluate import load_split
    from mi_refgs.runs.run import Run

    folder.require_free(args.output)
    source = Run(args.run_folder)
    base = folder.read_scene(source)
    # Selected and changed is what is joined, where something is.
    of = source if args.join is None else Run(args.join)
    scene = base if args.join is None else folder.read_scene(of)
    camera = mask = None
    if args.mask is not None:
        views = load_split(of, of.method(), args.split, args.data).views
        if not 0 <= args.view < len(views):
            raise InputError(f"--view: {args.view}: there are {len(views)} {args.split} views; give 0 to "
                             f"{len(views) - 1}")  # fmt: skip
        camera = views[args.view].camera()
        mask = read_mask(args.mask, camera)
    given = {name: getattr(args, name) for name in OPTIONS}
    into = None if args.join is None else base
    try:
        edited = edit(scene, **given, mask=mask, camera=camera, into=into)
    except InputError as error:
        raise InputError(f"{of.path}: {error}") from error
    for note in edited.notes:
        say(f"note: {note}")
    preview = None
    if args.preview:
        views_shown = folder.test_views(source, args.data if args.join is None else None)
        shown_from = folder.scene_camera(source)
        preview = folder.before_and_after(base, edited.scene, views_shown, shown_from)
    record = {name: value for name, value in given.items() if value not in (None, False, [], 1.0)}
    record |= {"view": args.view, "split": args.split} if mask is not None else {}
    files = {name: getattr(args, name) for name in ("mask", "join", "data")}
    record |= {name: str(path.resolve()) for name, path in files.items() if path is not None}
    entry = folder.write_edited(source, edited, args.output, record, preview, args.data)
    total = edited.scene.surfels.count
    text = f"{args.output}: {edited.selected} of {edited.of} surfels; it has {total}"
    return Result({"output": str(args.output), **entry}, text)
