"""How fast a page of `refgs view` is: in a headless browser, on a run.

    python -m benchmarks.viewer RUN [--window 1000x640]

Measures, with the viewer in a process of its own:

    first_picture_s   from the page's opening until the canvas shows the object
    orbit             while the camera is dragged round: images a second that the page received, and CPU
                      milliseconds of the viewer for each (user and system, of all its threads)

The browser draws in software and shares the machine with the viewer: what it takes is given as browser_cpu_s.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil

from benchmarks.common.report import plain_parser

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
COUNTER = """
window.refgsPictures = 0;
const made = URL.createObjectURL;
URL.createObjectURL = (blob) => {
  if (blob.type && blob.type.startsWith('image/')) window.refgsPictures += 1;
  return made.call(URL, blob);
};
"""
"""Counts the images that the page decodes: each becomes an object URL."""


def cpu_seconds(process: psutil.Process) -> float:
    """User and system time of a process and all its threads."""
    times = process.cpu_times()
    return float(times.user + times.system)


def browser_cpu() -> float:
    """CPU seconds of all chromium processes that this one has started, as far as they still run."""
    total = 0.0
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.NoSuchProcess):
            if "chrom" in process.name():
                total += cpu_seconds(process)
    return total


class Viewer:
    """`refgs view` in a process of its own."""

    def __init__(self, run: Path, saved: Path) -> None:
        begin, pipe = time.monotonic(), subprocess.PIPE
        command = ["view", str(run), "--port", "0", "-o", str(saved), "--json"]
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mi_refgs", *command], stdout=pipe, stderr=pipe, text=True
        )
        found = (re.search(r"http://\S+", line) for line in self.process.stderr or ())
        self.url = next((address[0] for address in found if address), "")
        if not self.url:
            raise SystemExit(f"refgs view {run} did not start")
        self.ready_s = time.monotonic() - begin

    def stop(self) -> None:
        """End it as Ctrl-C does."""
        self.process.send_signal(2)
        try:
            self.process.wait(30)
        finally:
            self.process.kill()


def find_browser() -> str | None:
    """The installed browser."""
    return next((path for name in BROWSERS if (path := shutil.which(name))), None)


@contextlib.contextmanager
def opened(run: Path, window: str) -> Iterator[tuple[Viewer, Any]]:
    """`refgs view` of a run, and an empty page, WIDTHxHEIGHT pixels, that counts its images as COUNTER does.

    Exits if no browser is installed.
    """
    from playwright.sync_api import sync_playwright

    if (browser_path := find_browser()) is None:
        raise SystemExit("no chromium is installed; apt-get install chromium")
    width, height = (int(x) for x in window.split("x"))
    with tempfile.TemporaryDirectory() as saved, sync_playwright() as playwright:
        viewer = Viewer(run, Path(saved))
        try:
            browser = playwright.chromium.launch(executable_path=browser_path, args=OPTIONS)
            page = browser.new_page(viewport={"width": width, "height": height})
            page.add_init_script(COUNTER)
            yield viewer, page
            browser.close()
        finally:
            viewer.stop()


def first_picture(page: Any, url: str) -> float:
    """Seconds until the canvas shows something."""
    begin = time.monotonic()
    page.goto(url)
    page.wait_for_function("window.refgsPictures > 0", timeout=60000, polling=20)
    page.wait_for_timeout(50)  # to the screen
    return time.monotonic() - begin


def orbit(page: Any, viewer: Viewer, seconds: float) -> dict[str, float]:
    """Drag the camera round for some time."""
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    process = psutil.Process(viewer.process.pid)
    before, cpu, browser = page.evaluate("window.refgsPictures"), cpu_seconds(process), browser_cpu()
    begin = time.monotonic()
    step = 0
    while time.monotonic() - begin < seconds:
        step += 1
        page.mouse.move(x + 0.3 * box["width"] * ((step % 120) / 60 - 1), y + (step % 40))
        page.wait_for_timeout(8)
    taken = time.monotonic() - begin
    images = page.evaluate("window.refgsPictures") - before
    result = {
        "seconds": round(taken, 2),
        "images": images,
        "pictures_per_s": round(images / taken, 2),
        "cpu_ms_per_picture": round(1000 * (cpu_seconds(process) - cpu) / max(images, 1), 1),
        "browser_cpu_s": round(browser_cpu() - browser, 2),
    }
    page.mouse.up()
    return result


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """All of it."""
    errors: list[str] = []
    with opened(args.run, args.window) as (viewer, page):
        page.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        result: dict[str, Any] = {
            "run": str(args.run),
            "window": args.window,
            "cores": os.cpu_count(),
            "load_before": os.getloadavg()[0],
            "ready_s": round(viewer.ready_s, 2),
            "first_picture_s": round(first_picture(page, viewer.url), 2),
        }
        page.wait_for_timeout(3000)
        result["orbit"] = orbit(page, viewer, args.seconds)
        result["console_errors"] = errors
        result["load_after"] = os.getloadavg()[0]
    return result


def main() -> None:
    """Measure, and print JSON."""
    parser = plain_parser("viewer", __doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--seconds", type=float, default=10.0, help="of each orbit")
    parser.add_argument("--window", default="1000x640", help="pixels of the page")
    print(json.dumps(measure(parser.parse_args()), indent=1))


if __name__ == "__main__":
    main()
