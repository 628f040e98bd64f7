"""`refgs view`: a page that renders a run in the browser."""

import contextlib
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import arg

from mi_refgs.cli.command import OptionalOutput, OtherData, Rendering, Result, RunFolder
from mi_refgs.errors import require_package
from mi_refgs.io.progress import say


@dataclass(frozen=True, kw_only=True)
class View:
    """Requires the viewer: pip install "mi_refgs[view]".

    example:
      refgs view runs/glossy --port 8080"""

    run_folder: RunFolder
    output: OptionalOutput = None  # folder of saved views (default: RUN/views)
    port: Annotated[int, arg(metavar="P")] = 8080  # port of the page
    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """address to listen at; 0.0.0.0 makes the page available to other machines, too"""
    data: OtherData = None
    common: Rendering = Rendering()

    def run(self) -> Result:
        from mi_refgs.runs.run import Run
        from mi_refgs.viewer.serve import serve

        require_package("viser", "view", "view")
        page = serve(Run(self.run_folder), (self.host, self.port), self.output, self.data)
        say(f"open {page.url} in a browser; Ctrl-C ends it")
        with contextlib.suppress(KeyboardInterrupt), contextlib.closing(page):
            page.loop.run()
        shown = page.loop.delivered
        return Result({"url": page.url, "images": shown}, f"{shown} images displayed")
