"""Saving of the displayed view: as PNG, as EXR, as a camera."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.evaluation.images import image_array
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import cannot_write, make_folder
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.types import Float
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, composited, displayed_planes, premultiplied
from mi_refgs.viewer.viewer_scene import SampleRequest, ViewerScene

NUMBERED = re.compile(r"view_\d{3,6}", re.ASCII)
"""Names of saved views. The number after a longer one may be too long for the name of a file."""
CAMERA = ".json"


def add_saving(page: Page) -> None:
    """Add the controls."""
    gui = page.server.gui
    with gui.add_folder("Save"):
        buttons = {
            suffix: gui.add_button(label, hint=hint)
            for suffix, label, hint in (
                (".png", "PNG", "The view as displayed, 16 samples per pixel, and its camera."),
                (".exr", "EXR", "Linear radiance and alpha, or the AOV, and its camera."),
                (CAMERA, "Camera", "A transforms file of this view."),
            )
        }
        saved = gui.add_markdown(f"into {page.views_folder}")

    def save(suffix: str, number: int) -> None:
        client = page.loop.clients.get(number)
        if client is not None and client.pose is not None:
            request = SampleRequest(client.pose, *client.window, page.loop.look)
            saved.content = f"saved {write_view(page.scene, request, page.views_folder, suffix)}"

    for suffix, button in buttons.items():

        @button.on_click
        def _(event: Any, suffix: str = suffix) -> None:
            number = event.client.client_id
            page.loop.submit(("save", suffix, number), lambda: save(suffix, number), changes=False)


def write_view(scene: ViewerScene, request: SampleRequest, folder: Path, suffix: str) -> Path:
    """Write the next numbered view in a folder, and its camera.

    Returns the path of the image, or of the camera if `suffix` is CAMERA. Raises InputError if it cannot be
    written.
    """
    make_folder(folder)
    camera = write_camera(folder, request)
    image = camera.with_suffix(suffix)
    if suffix != CAMERA:
        try:
            write_image(image, scene.fine(request), (request.height, request.width), request.look)
        except BaseException:
            camera.unlink(missing_ok=True)
            raise
    return image


def write_camera(folder: Path, request: SampleRequest) -> Path:
    """Write the camera as a transforms file with the next number; other files stay as they are.

    The viewer that creates the file first gets the number, so two viewers may save into one folder. Raises
    InputError if it cannot be written.
    """
    stems = {path.name.partition(".")[0] for path in folder.iterdir()}
    number = max((int(stem[5:]) for stem in stems if NUMBERED.fullmatch(stem)), default=-1)
    while True:
        number += 1
        path = folder / f"view_{number:03d}{CAMERA}"
        if path.stem in stems:
            continue
        content = request.pose.transforms(request.width, request.height, path.stem)
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(json.dumps(content, indent=1) + "\n")
        except FileExistsError:
            continue
        except OSError as error:
            raise cannot_write(path, error) from error
        return path


def write_image(path: Path, planes: list[Float], size: tuple[int, int], look: DisplayOptions) -> None:
    """Write planes of `tonemap.planes_of`, height × width, as PNG, as displayed, or as EXR, linear."""
    if path.suffix == ".exr":
        values = composited(planes, look)
        if look.what != IMAGE:
            values = premultiplied(look.what, values, planes[-1])
        write_exr(path, image_array(values, *size), {2: "YA", 4: "RGBA"}[len(values)])
    elif look.what == IMAGE and len(planes) == 4:  # nothing behind the object
        rgba = image_array(planes, *size)
        rgba[..., :3] *= np.float32(2.0**look.exposure)
        write_png(path, straight_srgb(rgba))
    else:
        write_png(path, image_array(displayed_planes(planes, look), *size))
