"""`refgs demo`: the main job on a small scene that comes with the package, up to a contact sheet."""

from __future__ import annotations

import argparse
from typing import Any

from mi_refgs.cli.command import Result, add_command, add_output, add_settings, say
from mi_refgs.cli.evaluate import table
from mi_refgs.io.resources import resource_dir

SCENE = "glossy_demo.xml"
VIEWS, TEST_VIEWS, SIZE, SAMPLES = 60, 8, 112, 64
"""Sized so that all of it takes less than 8 minutes on two cores; the tracing takes one of them."""
PRESET = "quick"


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "path-trace a small glossy scene, fit it, evaluate it, and write a contact sheet"
    parser = add_command(commands, "demo", summary, "refgs demo -o runs/demo", run)
    add_output(parser, "folder for data set and run; run again, it goes on where it stopped", "DIR")
    parser.add_argument("--preset", default=PRESET, metavar="P", help="how long to fit (default %(default)s)")
    add_settings(parser)


def run(args: argparse.Namespace) -> Result:
    """Trace, fit, evaluate; what is finished already is not done again."""
    from mi_refgs.evaluation.evaluate import SHEET, read_metrics
    from mi_refgs.reconstruction.fit import fit
    from mi_refgs.runs.run import Run
    from mi_refgs.synthesis.make_dataset import make_dataset

    data, output = args.output / "data", args.output / args.preset
    folder = Run(output)
    if folder.exists():
        folder.method()
    else:
        folder.require_none()
    say(f"1 of 3: tracing {VIEWS + TEST_VIEWS} views of {SCENE} into {data}")
    make_dataset(
        resource_dir("scenes") / SCENE,
        data,
        views=VIEWS,
        test_views=TEST_VIEWS,
        size=SIZE,
        spp=SAMPLES,
        environment_height=64,
    )
    say(f"2 of 3: fitting into {output}")
    found = fit(data, preset=args.preset, settings=args.set, output=output, resume=True)
    say("3 of 3: evaluating")
    result = read_metrics(folder)
    if (
        result is None
        or result.get("iterations") != found.trained.iteration
        or not (output / SHEET).is_file()
    ):
        result = found.evaluate(progress=True)
    sheet = output / SHEET
    text = f"{table(result)}\nlook at the contact sheet: {sheet}\nor open the scene: {output / 'scene.xml'}"
    return Result(
        {"contact_sheet": str(sheet), "run": str(output), "data": str(data), "metrics": result}, text
    )
