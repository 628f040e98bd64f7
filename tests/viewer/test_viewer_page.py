"""`refgs view` in a real browser: what the page shows, and that its controls do what they say.

By default: the light turns, a slider does what it says, another variable is shown, bad input is told. The
rest takes minutes on a busy machine and is marked as slow.
"""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from benchmarks.viewer import OPTIONS, find_browser
from mi_refgs.data.dataset import read_dataset
from mi_refgs.editing.change import apply
from mi_refgs.editing.options import Change, Selection
from mi_refgs.editing.selection import select
from mi_refgs.evaluation.images import image_array
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.methods.read import load
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat import Camera
from mi_refgs.viewer.pose import Pose
from tests.helpers import ROOT
from tests.scenes.known import other_sky, with_background
from tests.scenes.tiny import train_command, write_data, write_method, write_open_data

WINDOW = {"width": 760, "height": 420}
"""Small: browser and viewer draw on the same processor. The image is as wide as it is high."""
SMALL = "200²"
"""Pixels at rest."""
PATIENCE = 45.0
"""Seconds that a page may take to show something, on a busy machine."""

browser_path = find_browser()
pytestmark = pytest.mark.skipif(
    browser_path is None, reason="no chromium is installed; apt-get install chromium"
)


class Server:
    """`refgs …` in a process of its own."""

    def __init__(self, *arguments: str | Path) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", "mi_refgs", *map(str, arguments)],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []
        self._url = ""
        self._known = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def url(self) -> str:
        """The address, as soon as it is printed."""
        assert self._known.wait(PATIENCE) and self._url, "".join(self.said)
        return self._url

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line)
            if found := re.search(r"http://\S+", line):
                self._url = found[0]
                self._known.set()
        self._known.set()

    def stop(self) -> str:
        """End it as Ctrl-C does; returns what it printed as its result."""
        self.process.send_signal(2)
        try:
            self.process.wait(PATIENCE)
        finally:
            self.process.kill()
        self._reader.join(PATIENCE)
        assert self.process.stdout is not None and self.process.stderr is not None
        with self.process.stdout, self.process.stderr:
            return self.process.stdout.read()


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
        box = self.page.locator("canvas").first.bounding_box()
        clip = {
            "x": box["x"] + 0.3 * box["width"],
            "y": box["y"] + 0.1 * box["height"],
            "width": 0.65 * box["width"],
            "height": 0.8 * box["height"],
        }
        return np.asarray(Image.open(io.BytesIO(self.page.screenshot(clip=clip))).convert("RGB"), np.int16)

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
        """Wait until the canvas is as before."""
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
        return (
            self.page.get_by_text(label, exact=True)
            .locator("xpath=ancestor::*[.//input][1]")
            .locator("input")
        )

    def type(self, label: str, value: str) -> None:
        """Type into a control."""
        field = self.row(label).last
        field.fill(value)
        field.press("Enter")

    def choose(self, label: str, value: str) -> None:
        """Choose in a drop-down."""
        self.row(label).first.click()
        self.page.get_by_role("option", name=value, exact=True).click()

    def press(self, label: str) -> None:
        """Press a button."""
        self.page.get_by_role("button", name=label, exact=True).click()


@pytest.fixture(scope="module")
def known_run(scene: TrainedScene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run of it, with the cameras of the tiny data set."""
    folder = tmp_path_factory.mktemp("view")
    data = write_data(folder / "data")
    run = Run(folder / "run")
    run.create(load("ref_gaussian", "quick"), str(data))
    export(scene, run.path, read_dataset(data, "test").views[0].camera())
    return run.path


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """A browser without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=browser_path, args=OPTIONS)
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def server(known_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, Path]]:
    """`refgs view` of the run, and the folder that it saves into."""
    saved = tmp_path_factory.mktemp("saved")
    running = Server("view", known_run, "--port", "0", "-o", saved)
    yield running, saved
    assert "images displayed" in running.stop()


@pytest.fixture(scope="module")
def opened(server: tuple[Server, Path], chromium: Any) -> Iterator[Tab]:
    """A page of it with small images, of which 16 samples take less time."""
    page = chromium.new_page(viewport=WINDOW)
    tab = Tab(page, server[0].url)
    tab.choose("Still", SMALL)
    yield tab
    page.close()


@pytest.fixture
def tab(opened: Tab) -> Iterator[Tab]:
    """The page; each test leaves its controls as they were, and the browser's console without an error."""
    yield opened
    assert opened.errors == []


@pytest.fixture
def photographed(
    scene: TrainedScene, known_run: Path, chromium: Any, tmp_path: Path
) -> Iterator[tuple[Tab, Path]]:
    """A page of a run whose second ball is the first one's background, and the folder of its saved views."""
    run = shutil.copytree(known_run, tmp_path / "run")
    camera = Pose(np.eye(4), 0.7, 1.0).camera(8, 8)
    export(with_background(scene, 0.2), run, camera)
    (tmp_path / "saved").mkdir()
    running = Server("view", run, "--port", "0", "-o", tmp_path / "saved")
    page = chromium.new_page(viewport=WINDOW)
    try:
        tab = Tab(page, running.url)
        yield tab, tmp_path / "saved"
        assert tab.errors == []
    finally:
        page.close()
        running.stop()


def saved_view(folder: Path, suffix: str, before: set[Path]) -> Path:
    """The image that appears beside those of before, with its camera."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        new = set(folder.iterdir()) - before
        cameras = [path for path in new if path.suffix == ".json"]
        if cameras and cameras[0].with_suffix(suffix) in new:
            return cameras[0].with_suffix(suffix)
        time.sleep(0.1)
    raise AssertionError(f"no {suffix} in {folder}")


def camera_of(path: Path) -> Camera:
    """The camera beside a saved image."""
    content = json.loads(path.with_suffix(".json").read_text())
    to_world = np.array(content["frames"][0]["transform_matrix"]) @ np.diag([-1.0, 1, -1, 1])
    near = 0.0
    fov = 2 * np.arctan(content["h"] / 2 / content["fl_y"])
    return Pose(to_world, fov, content["w"] / content["h"], near).camera(content["w"], content["h"])


def rendered(scene: TrainedScene, camera: Camera) -> np.ndarray:
    """Linear RGBA (H, W, 4) of 16 samples."""
    frame = scene.renderer(aovs=False, samples=16)(camera)
    return image_array([*frame.radiance, frame.alpha], camera.height, camera.width)


def test_the_page_displays_the_object_and_rotates_its_light(tab: Tab) -> None:
    tab.until(lambda image: float(image.std()) > 10, "an image")
    before = tab.still()
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 500
    tab.type("Turn", "120")
    tab.differs(before, 5, "another light")
    tab.press("Estimated environment map")
    tab.returns(before, "the light as it was")


def test_the_roughness_slider_displays_and_saves_the_edited_scene(
    tab: Tab, scene: TrainedScene, server: tuple[Server, Path]
) -> None:
    folder = server[1]
    before = tab.still()
    tab.type("Where", "metallic > 0.5")
    tab.page.get_by_text("3,000 of 6,000 surfels").wait_for(timeout=1000 * PATIENCE)
    tab.type("Roughness", "0.9")
    tab.differs(before, 0.5, "rough metal")
    known = set(folder.iterdir())
    tab.press("EXR")
    path = saved_view(folder, ".exr", known)
    chosen = select(scene, Selection(where="metallic > 0.5"))
    edited = apply(scene, chosen, Change(set={"roughness": 0.9}))
    found, camera = read_exr_image(path), camera_of(path)
    unlike, like = (np.abs(found - rendered(given, camera)) for given in (scene, edited))
    assert unlike.max() > 0.1
    assert like.max() < 0.02 and like.mean() < 1e-5  # files keep fewer digits of camera, light and channels
    tab.press("As fitted")
    tab.returns(before, "the scene as it was")
    tab.type("Where", "")
    tab.page.get_by_text("6,000 of 6,000 surfels").wait_for(timeout=1000 * PATIENCE)


def test_a_bad_selection_is_one_sentence_on_the_page(tab: Tab) -> None:
    """Below the field, where it may come and go while one types; no message covers the image."""
    for text, said in (("metallic > ", "a name or a number is missing"), ("x < {", "'{' is not allowed")):
        tab.type("Where", text)
        tab.page.get_by_text(said).wait_for(timeout=1000 * PATIENCE)
    assert tab.page.get_by_text("(still 6,000 of 6,000 surfels)").count() == 1
    assert tab.page.get_by_text("Not done").count() == 0
    tab.type("Where", "")
    tab.page.get_by_text("6,000 of 6,000 surfels", exact=True).wait_for(timeout=1000 * PATIENCE)


def test_an_aov_is_displayed_and_saved(tab: Tab, server: tuple[Server, Path]) -> None:
    before = tab.still()
    tab.choose("Show", "normal")
    image = tab.differs(before, 5, "normals")
    known = set(server[1].iterdir())
    tab.press("PNG")
    path = saved_view(server[1], ".png", known)
    png = np.asarray(Image.open(path).convert("RGB"), np.int16)
    assert png.std() > 10 and image.std() > 10
    tab.choose("Show", "image")
    tab.returns(before, "the image")


DROP = """(content) => {
    const data = new DataTransfer();
    data.items.add(new File([new Uint8Array(content)], 'dusk.exr'));
    const how = {dataTransfer: data, bubbles: true, cancelable: true};
    window.dispatchEvent(new DragEvent('drop', how));
}"""
"""Drops a file onto the page."""


@pytest.mark.slow
@pytest.mark.parametrize("dropped", [False, True])
def test_an_uploaded_or_dropped_image_becomes_the_light(
    dropped: bool, tab: Tab, scene: TrainedScene, server: tuple[Server, Path], tmp_path: Path
) -> None:
    before, file = tab.still(), tmp_path / "dusk.exr"
    write_exr(file, other_sky())
    tab.row("Map has world directions").check(force=True)
    if dropped:
        tab.page.evaluate(DROP, list(file.read_bytes()))
    else:
        tab.page.locator("input[type=file]").set_input_files(file)
    tab.differs(before, 1, "another light")
    known = set(server[1].iterdir())
    tab.press("EXR")
    path = saved_view(server[1], ".exr", known)
    dusk = replace(scene, light=EnvironmentLight.from_radiance(other_sky()))
    found, wanted = read_exr_image(path), rendered(dusk, camera_of(path))
    assert np.abs(found - wanted).max() < 0.02 * wanted.max()
    tab.press("Estimated environment map")


@pytest.mark.slow
def test_orbiting_moves_the_object_and_test_views_are_beside_it(tab: Tab) -> None:
    before = tab.still()
    box = tab.page.locator("canvas").first.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    tab.page.mouse.move(x, y)
    tab.page.mouse.down()
    for step in range(12):
        tab.page.mouse.move(x + 12 * step, y + 3 * step)
    tab.page.mouse.up()
    tab.differs(before, 3, "another side")
    tab.page.get_by_text("Test views", exact=True).click()
    tab.press("next")
    tab.page.get_by_text(re.compile(r"PSNR [\d.]+ dB")).wait_for(timeout=1000 * PATIENCE)
    tab.until(lambda image: bool((image == round(255 * 0.12)).mean() > 0.02), "two images")
    tab.press("leave")
    tab.until(lambda image: not (image == round(255 * 0.12)).mean() > 0.02, "one image")


@pytest.mark.slow
def test_overlays_are_drawn(tab: Tab) -> None:
    before = tab.still()
    tab.row("Cameras").first.check(force=True)
    tab.until(lambda image: bool(np.abs(image - before).max() > 50), "cameras")
    tab.row("Cameras").first.uncheck(force=True)
    tab.row("Mesh").first.check(force=True)
    tab.differs(before, 1, "the mesh")
    tab.row("Mesh").first.uncheck(force=True)


@pytest.mark.slow
def test_a_photographed_object_is_displayed_with_background_then_without(
    photographed: tuple[Tab, Path],
) -> None:
    tab, folder = photographed
    left = np.s_[:, :40]  # where only the background is visible
    before = tab.still()
    assert (before[left] == 124).all(axis=2).any()  # 0.2 as sRGB
    assert (np.abs(before[left] - 124).max(axis=2) > 20).any()
    tab.row("Mesh").first.check(force=True)
    tab.until(lambda image: bool(np.abs(image - before)[left].max() > 20), "the whole mesh")
    tab.choose("Backdrop", "black")
    alone = tab.until(lambda image: bool(image[left].max() == 0), "the object and its part of the mesh")
    assert alone.max() > 100
    known = set(folder.iterdir())
    tab.press("EXR")
    assert read_exr_image(saved_view(folder, ".exr", known))[..., 3].min() == 0
    tab.row("Mesh").first.uncheck(force=True)
    tab.choose("Backdrop", "background")
    tab.returns(before, "the background")


@pytest.mark.slow
def test_the_region_is_saved_and_a_painted_object_is_masked(
    scene: TrainedScene, known_run: Path, chromium: Any, tmp_path: Path
) -> None:
    run, data = shutil.copytree(known_run, tmp_path / "run"), write_open_data(tmp_path / "data")
    export(with_background(scene, 0.2), run, Pose(np.eye(4), 0.7, 1.0).camera(8, 8))
    running = Server("view", run, "--data", data, "--port", "0")
    page = chromium.new_page(viewport=WINDOW)
    try:
        tab = Tab(page, running.url)
        before = tab.still()
        page.get_by_text("Region of interest", exact=True).click()
        tab.row("Border").first.evaluate("box => box.click()")
        tab.differs(before, 0.5, "the border")
        tab.type("Radius", "0.5")
        tab.type("Region file", str(data / "region.json"))
        tab.press("Save region")
        page.get_by_text("; next: ").wait_for(timeout=1000 * PATIENCE)
        assert json.loads((data / "region.json").read_text())["radius"] == pytest.approx(0.5, abs=0.01)
        tab.row("Border").first.evaluate("box => box.click()")
        tab.returns(before, "the image without the border")
        page.get_by_text("Masks", exact=True).click()
        box = page.locator("canvas").first.bounding_box()
        page.keyboard.down("Shift")
        page.mouse.move(box["x"] + 0.05 * box["width"], box["y"] + 0.05 * box["height"])
        page.mouse.down()
        page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.6 * box["height"], steps=5)
        page.mouse.move(box["x"] + 0.95 * box["width"], box["y"] + 0.95 * box["height"], steps=5)
        page.mouse.up()
        page.keyboard.up("Shift")
        tab.differs(before, 2, "the painted ball")
        tab.press("Write masks")
        page.get_by_text("wrote 10 masks").wait_for(timeout=1000 * PATIENCE)
        assert (data / "masks/train/r_7.png.png").is_file() and tab.errors == []
    finally:
        page.close()
        running.stop()


@pytest.mark.slow
def test_a_running_fit_is_displayed(chromium: Any, tmp_path: Path) -> None:
    data, method = write_data(tmp_path / "data"), write_method(tmp_path)
    command = train_command(data, tmp_path / "run", method, "--watch", "--port", "0")
    running = Server(*command, "iterations=1000000", "checkpoint_every=100000")
    page = chromium.new_page(viewport=WINDOW)
    try:
        tab = Tab(page, running.url)
        tab.until(lambda image: float(image.std()) > 5, "an image")
        page.wait_for_function("document.querySelectorAll('.uplot').length >= 2", timeout=1000 * PATIENCE)
        before = tab.canvas()
        tab.differs(before, 0.1, "a later image")
        assert tab.errors == []
    finally:
        page.close()
        running.stop()
    assert any("resume with: refgs train" in line for line in running.said)
