"""Film `refgs view RUN` in a headless browser. A tool of maintainers.

`python docs/film_maker.py --run RUN --output docs/images/viewer.webp`: the camera turns, the display changes
to normals and back, the light turns, and a material changes; every frame waits for the finished image. Needs
the extra `dev`, and chromium.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gallery_maker import write_turntable

from benchmarks.viewer import first_picture, opened

WINDOW = "1000x640"  # pixels of the page
STEP_SECONDS = 0.12  # of the film, per frame
SETTLED_MS = 1200  # without a new image, after which the last one is finished
DRAG = 11  # pixels per frame that the mouse drags the camera


def film(run: Path, output: Path) -> None:
    """Write the film of a run to `output` (WebP)."""
    with opened(run, WINDOW) as (viewer, page):
        first_picture(page, viewer.url)
        shots = [Image.open(io.BytesIO(page.screenshot())).convert("RGB") for _ in scenes(page)]
    frames = [np.array(shot) / 255.0 for shot in shots]
    write_turntable(output, frames, STEP_SECONDS * len(frames))


def scenes(page: Any) -> Iterator[None]:
    """Yield whenever the page is ready for a frame."""
    settle(page)
    notice = page.locator(".mantine-Notification-closeButton")  # of the browser, which draws in software
    if notice.count():
        notice.first.click()
    yield from orbited(page, 12)
    choose(page, "Show", "normal")
    yield from orbited(page, 6)
    choose(page, "Show", "image")
    yield from typed(page, "Turn", np.arange(20, 241, 20))
    yield from typed(page, "Roughness", np.linspace(0.2, 0.6, 5))
    yield from orbited(page, 6)


def choose(page: Any, label: str, value: str) -> None:
    """Choose in a drop-down."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
    row.locator("input").first.click()
    page.get_by_role("option", name=value, exact=True).click()


def orbited(page: Any, count: int) -> Iterator[None]:
    """Drag the camera round, by DRAG pixels per frame."""
    box = page.locator("canvas").first.bounding_box()
    x, y = box["x"] + 0.35 * box["width"], box["y"] + box["height"] / 2
    for _ in range(count):
        page.mouse.move(x, y)
        page.mouse.down()
        page.mouse.move(x + DRAG, y, steps=2)
        page.mouse.up()
        settle(page)
        yield


def typed(page: Any, label: str, values: np.ndarray) -> Iterator[None]:
    """Type values into the number beside a slider."""
    row = page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
    for value in values:
        row.locator("input[type=text], input:not([type])").last.fill(f"{value:g}")
        page.keyboard.press("Enter")
        settle(page)
        yield


def settle(page: Any) -> None:
    """Wait until the page has received no image for SETTLED_MS."""
    before = -1
    while (now := page.evaluate("window.refgsPictures")) != before:
        before = now
        page.wait_for_timeout(SETTLED_MS)


if __name__ == "__main__":
    tyro.cli(film)
