"""`refgs view` in a real browser: every panel of a page."""

import io
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.editing.change import apply, assignments
from mi_refgs.editing.options import Selection
from mi_refgs.editing.selection import select
from mi_refgs.formats.cameras import read_cameras
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.methods.read import load
from mi_refgs.render.display import image_array
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera
from mi_refgs.viewer.pose import Pose
from tests.helpers import ROOT
from tests.scenes.known import other_sky, with_background
from tests.scenes.tiny import write_open_data

WINDOW = {"width": 760, "height": 420}
"""Small: browser and viewer draw on the same processor. The image is as wide as it is high."""
SMALL = "200²"  # pixels at rest
PATIENCE = 90.0  # seconds that a page may take to show something, on a busy machine

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
OPTIONS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]

browser_path = next((path for name in BROWSERS if (path := shutil.which(name))), None)
pytestmark = pytest.mark.skipif(browser_path is None, reason="no chromium; apt-get install chromium")


class Server:
    """`refgs …` in a process of its own, whose standard error is a file."""

    def __init__(self, log: Path, *arguments: str | Path) -> None:
        command = [sys.executable, "-m", "mi_refgs", *map(str, arguments)]
        more: dict[str, Any] = {"cwd": ROOT, "env": os.environ | {"PYTHONPATH": str(ROOT)}, "text": True}
        self.log = log
        with log.open("w") as file:
            self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=file, **more)

    @property
    def url(self) -> str:
        """The address, as soon as it is printed."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end and self.process.poll() is None:
            if found := re.search(r"http://\S+", self.log.read_text()):
                return found[0]
            time.sleep(0.1)
        raise AssertionError(self.log.read_text())

    def stop(self) -> str:
        """End it as Ctrl-C does; returns what it printed as its result."""
        self.process.send_signal(2)
        try:
            return str(self.process.communicate(timeout=PATIENCE)[0])
        finally:
            self.process.kill()


class Tab:
    """A page in the browser."""

    def __init__(self, page: Any, url: str) -> None:
        self.page = page
        self.errors: list[str] = []
        page.on("console", lambda m: self.errors.append(m.text) if m.type == "error" else None)
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.goto(url)
        # Messages may cover the image, such as that on WebGL in software.
        page.add_style_tag(content=".mantine-Notifications-root { visibility: hidden }")

    def canvas(self) -> np.ndarray:
        """The canvas (H, W, 3) without its edges, which other things may cover."""
        x, y, width, height = self.page.locator("canvas").first.bounding_box().values()
        clip = {"x": x + 0.3 * width, "y": y + 0.1 * height, "width": 0.65 * width, "height": 0.8 * height}
        content = self.page.screenshot(clip=clip, timeout=1000 * PATIENCE)
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.int16)

    def until(self, done: Callable[[np.ndarray], bool], what: str) -> np.ndarray:
        """The canvas as soon as it is so."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.page.wait_for_timeout(50)
            if done(image := self.canvas()):
                return image
        raise AssertionError(f"not within {PATIENCE} s: {what}")

    def differs(self, before: np.ndarray, mean: float, what: str) -> np.ndarray:
        """Wait until the canvas differs by more than `mean` on average."""
        return self.until(lambda image: bool(np.abs(image - before).mean() > mean), what)

    def returns(self, before: np.ndarray, what: str) -> np.ndarray:
        return self.until(lambda image: bool(np.abs(image - before).mean() < 0.5), what)

    def still(self) -> np.ndarray:
        """The canvas once the image is supersampled and stays."""
        self.page.get_by_text(re.compile(r"× \d+, 16 per pixel")).wait_for(timeout=1000 * PATIENCE)
        before, same = self.canvas(), 0
        for _ in range(200):
            self.page.wait_for_timeout(100)
            same = same + 1 if np.array_equal(now := self.canvas(), before) else 0
            if same == 3:  # a busy browser takes its time to decode an image
                return now
            before = now
        raise AssertionError("the canvas does not come to rest")

    def row(self, label: str) -> Any:
        """The input of the control with this label."""
        found = self.page.get_by_text(label, exact=True).locator("xpath=ancestor::*[.//input][1]")
        return found.locator("input")

    def type(self, label: str, value: str) -> None:
        field = self.row(label).last
        field.fill(value)
        field.press("Enter")

    def choose(self, label: str, value: str) -> None:
        self.row(label).first.click()
        self.page.get_by_role("option", name=value, exact=True).click()

    def press(self, label: str) -> None:
        self.page.get_by_role("button", name=label, exact=True).click()

    def check(self, label: str) -> None:
        """Tick a checkbox, or the opposite."""
        self.row(label).first.evaluate("box => box.click()")

    def says(self, text: str) -> None:
        """Wait for a text, or for a text field of this content."""
        script = """text => document.body.innerText.includes(text)
            || [...document.querySelectorAll('input')].some(i => i.value.includes(text))"""
        self.page.wait_for_function(script, arg=text, timeout=1000 * PATIENCE)


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path, args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture
def tab(chromium: Any, scene: TrainedScene, tmp_path: Path) -> Iterator[Tab]:
    """A page of a run before a background, with small images, and with photographs of a region."""
    data, run = write_open_data(tmp_path / "data"), Run(tmp_path / "run")
    run.create(load("ref_gaussian", "quick"), str(data))
    export(with_background(scene, 0.2), run.path, Pose(np.eye(4), 0.7, 1.0).camera(8, 8))
    arguments = ("view", run.path, "--data", data, "--port", "0", "-o", tmp_path / "saved")
    running = Server(tmp_path / "log", *arguments)
    page = chromium.new_page(viewport=WINDOW)
    try:
        opened = Tab(page, running.url)
        opened.choose("Still", SMALL)
        yield opened
    finally:
        page.close()
        result = running.stop()
    assert opened.errors == [] and "images displayed" in result


@pytest.mark.slow
def test_every_panel_does_what_it_says(tab: Tab, scene: TrainedScene, tmp_path: Path) -> None:
    """One page, from the first image to the saved view: opening it takes longer than its tests."""
    before = tab.still()
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 200

    # The light, turned, replaced, and restored.
    tab.type("Turn", "120")
    tab.differs(before, 1, "another light")
    tab.press("Estimated environment map")
    tab.returns(before, "the light as it was")
    write_exr(tmp_path / "dusk.exr", other_sky())
    tab.page.locator("input[type=file]").set_input_files(tmp_path / "dusk.exr")
    tab.differs(before, 0.5, "an uploaded light")
    tab.press("Estimated environment map")
    tab.returns(before, "the light as it was")

    # What is displayed.
    tab.choose("Show", "normal")
    tab.differs(before, 5, "normals")
    tab.choose("Show", "image")
    tab.page.mouse.move(200, 200)
    for _ in range(4):  # away from the camera of a view, to see its frustum
        tab.page.mouse.wheel(0, 300)
    tab.choose("Backdrop", "black")
    tab.differs(before, 5, "the object without background")
    alone = tab.still()

    # The region of interest and the cameras, over the image.
    tab.page.get_by_text("Region of interest", exact=True).click()
    tab.check("Border")
    tab.differs(alone, 0.5, "the border")
    tab.type("Radius", "0.5")
    (tmp_path / "data" / "region.json").unlink()
    tab.press("Save region")
    tab.says("; next: ")
    region = json.loads((tmp_path / "data" / "region.json").read_text())
    assert region["radius"] == pytest.approx(0.5, abs=0.01)
    tab.check("Border")
    tab.returns(alone, "the image without the border")
    tab.check("Cameras")
    tab.until(lambda image: bool(np.abs(image - alone).max() > 50), "cameras")
    tab.check("Cameras")
    tab.returns(alone, "the image without cameras")

    # A bad selection is a sentence; a good one is edited, and saved.
    metal = replace(with_background(scene), surroundings=None)
    chosen = select(metal, Selection(where="z > 0"))
    tab.type("Where", "z > ")
    tab.says("(still 3,000 of 3,000 surfels)")
    tab.type("Where", "z > 0")
    tab.says(f"{chosen.sum():,} of 3,000 surfels")
    tab.type("Roughness", "0.9")
    tab.differs(alone, 0.2, "rough metal")
    tab.still()
    tab.press("Save view")
    path = tmp_path / "saved" / "view_000.png"
    tab.until(lambda _: path.is_file(), "a saved view")
    edited = apply(metal, chosen, assignments({"roughness": 0.9}))
    found, camera = read_exr_image(path.with_suffix(".exr")), read_cameras(path.with_suffix(".json"))[0]
    unlike, like = (np.abs(found - rendered(given, camera)) for given in (metal, edited))
    assert unlike.max() > 0.1
    assert like.max() < 0.02 and like.mean() < 1e-5  # files keep fewer digits of camera, light and channels
    tab.press("As fitted")
    tab.returns(alone, "the scene as it was")


def rendered(scene: TrainedScene, camera: Camera) -> np.ndarray:
    """Linear RGBA (H, W, 4) of 16 samples."""
    frame = scene.renderer(aovs=False, samples=16)(camera)
    return image_array([*frame.radiance, frame.alpha], camera.height, camera.width)
