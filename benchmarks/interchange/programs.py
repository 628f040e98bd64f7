"""Other programs, each given a file that `refgs export --to` has written."""

from __future__ import annotations

import base64
import functools
import http.server
import io
import json
import shutil
import subprocess
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import mi_refgs  # noqa: F401  (chooses the LLVM before Dr.Jit loads)

import mitsuba as mi  # isort: skip

from benchmarks.common.view import perspective
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.formats.gltf import EXTENSION
from mi_refgs.io.images import srgb_from_linear
from mi_refgs.splat import Camera
from mi_refgs.surfels.ply import read_ply

CHROMIUM = "/usr/bin/chromium"
FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
FRAMES = 15
"""Frames, 0.2 s apart, in which the viewer sorts."""
MINUTE = 60_000  # milliseconds

VALIDATE = """
const validator = require("gltf-validator"), fs = require("fs");
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])), {maxIssues: 0})
  .then((report) => console.log(JSON.stringify(report.issues)));
"""


def validated(glb: Path, node: Path) -> dict[str, Any]:
    """Issues that Khronos' validator finds in a glTF file, but for attributes named as the extension names
    them: it does not know the extension, and takes the colon for a mistake."""
    done = subprocess.run(
        ["node", "-e", VALIDATE, str(glb.resolve())], cwd=node, capture_output=True, text=True, check=True
    )
    issues = json.loads(done.stdout)
    foreign = [m for m in issues["messages"] if m["pointer"].split("/")[-1].startswith(EXTENSION)]
    issues["messages"] = [message for message in issues["messages"] if message not in foreign]
    issues["numErrors"] -= len(foreign)
    return issues


def transformed(ply: Path, node: Path) -> dict[str, float]:
    """Largest difference by channel after PlayCanvas' splat-transform has read the file and written it."""
    with tempfile.TemporaryDirectory() as folder:
        again = Path(folder) / "again.ply"
        program = node / "node_modules/@playcanvas/splat-transform/bin/cli.mjs"
        subprocess.run(["node", program, ply, again], capture_output=True, check=True)
        before, after = read_ply(ply).to_numpy(), read_ply(again).to_numpy()
    return {name: float(np.abs(values - after[name]).max()) for name, values in before.items()}


def in_browser(ply: Path, camera: Camera, node: Path) -> np.ndarray:
    """What the Spark viewer shows on black, (H, W, 3) display-encoded, in headless Chromium."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        shutil.copy(ply, folder / "splats.ply")
        shutil.copy(Path(__file__).with_name("viewer.html"), folder)
        (folder / "node_modules").symlink_to(node.resolve() / "node_modules")
        handler = functools.partial(_Quiet, directory=name)
        with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
            threading.Thread(target=server.serve_forever, daemon=True).start()
            with sync_playwright() as browsers:
                browser = browsers.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
                page = browser.new_page(viewport={"width": camera.width, "height": camera.height})
                page.set_default_timeout(5 * MINUTE)
                page.on("console", lambda message: print(f"  browser: {message.text}"))
                page.goto(f"http://127.0.0.1:{server.server_port}/viewer.html")
                page.wait_for_function("window.ready")
                arguments = ["/splats.ply", camera.width, camera.height, *_opengl(camera), FRAMES]
                shot = page.evaluate("(a) => window.shoot(...a)", arguments)
                browser.close()
            server.shutdown()
    image = Image.open(io.BytesIO(base64.b64decode(shot["image"].partition(",")[2])))
    return np.asarray(image.convert("RGB"), dtype=np.float64) / 255


def _opengl(camera: Camera) -> tuple[list[list[float]], list[list[float]]]:
    """World from camera with OpenGL's axes, and the projection matrix."""
    near, far = 0.05, 1e3
    fx, fy, cx, cy = (float(x[0]) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    width, height = camera.width, camera.height
    projection = [
        [-2 * fx / width, 0.0, 1 - 2 * cx / width, 0.0],
        [0.0, -2 * fy / height, 2 * cy / height - 1, 0.0],
        [0.0, 0.0, -(far + near) / (far - near), -2 * far * near / (far - near)],
        [0.0, 0.0, -1.0, 0.0],
    ]
    return (camera.pose() @ MITSUBA_FROM_OPENGL).tolist(), projection


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args: Any) -> None:
        """Say nothing."""


def in_mitsuba(ply: Path, camera: Camera, samples: int = 16) -> np.ndarray:
    """What Mitsuba's own volprim_rf_basic makes of the file, on black (H, W, 3), display-encoded.

    Its integrator blends the colours of the file as they are, and then takes the sRGB curve off.
    """
    fx, cx, cy = (float(x[0]) for x in (camera.fx, camera.cx, camera.cy))
    sensor = perspective((camera.width, camera.height), fx, (cx, cy), camera.pose())
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "volprim_rf_basic", "max_depth": 256},
            "sensor": sensor,
            "splats": {"type": "ellipsoids", "filename": str(ply)},
        }
    )
    return srgb_from_linear(np.asarray(mi.render(scene, spp=samples), dtype=np.float64)[..., :3])
