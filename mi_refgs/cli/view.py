"""`refgs view`: a reconstruction in the browser, drawn by the renderer itself."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.cli.command import Result, add_command, say
from mi_refgs.cli.render import scene_file
from mi_refgs.errors import InputError

if TYPE_CHECKING:
    from mi_refgs.viewer.page import Page

EXAMPLE = "refgs view runs/glossy --port 8080"
HOST, PORT = "127.0.0.1", 8080


def add(commands: Any) -> None:
    """Add the command to the parser."""
    summary = "open a run in the browser: orbit it, turn its light, change its materials, save views"
    parser = add_command(commands, "view", summary, EXAMPLE, run)
    parser.add_argument("scene", type=Path, metavar="RUN|SCENE.xml", help="run folder, or a Mitsuba scene")
    parser.add_argument("--port", type=int, default=PORT, metavar="P", help="port (default %(default)s)")
    parser.add_argument(
        "--host",
        default=HOST,
        metavar="H",
        help="address to listen at; with 0.0.0.0 other machines can open the printed address, too "
        "(default %(default)s: this machine only)",
    )
    parser.add_argument(
        "--data", type=Path, metavar="DATA", help="another data set than the one it was fitted to"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="DIR", help="folder for saved views (default: RUN/views)"
    )


def run(args: argparse.Namespace) -> Result:
    """Serve the page until it is interrupted."""
    from mi_refgs.viewer.page import require_free, require_viser

    require_viser()
    require_free(args.host, args.port)
    page = _serve_run(args) if args.scene.is_dir() else _serve_scene(args)
    say(f"open {page.url} in a browser; Ctrl-C ends it")
    try:
        page.loop.run()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return Result({"url": page.url, "pictures": page.loop.delivered}, f"{page.loop.delivered} pictures shown")


def _serve_run(args: argparse.Namespace) -> Page:
    from mi_refgs.runs.run import Run
    from mi_refgs.viewer.serve import serve_run

    return serve_run(Run(args.scene), (args.host, args.port), args.output, args.data, say)


def _serve_scene(args: argparse.Namespace) -> Page:
    from mi_refgs.render.load_scene import load_scene
    from mi_refgs.viewer.serve import serve_scene

    if args.data is not None:
        raise InputError(f"--data: {args.data}: a scene has no data set; give the run, or drop --data")
    scene = load_scene(scene_file(args.scene), [])
    return serve_scene(scene, args.scene, (args.host, args.port), args.output, say)
