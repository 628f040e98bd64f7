"""Save what is seen: as PNG, as EXR, as a camera."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import cannot_write, make_folder
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.shade.points import TERMS
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, seen_of, shown_planes
from mi_refgs.viewer.viewer_scene import ViewerScene

NUMBERED = re.compile(r"view_\d{3,6}", re.ASCII)
"""Names of views. The number after a longer one may be too long for the name of a file."""
CAMERA = ".json"


def add(page: Page) -> None:
    """Add the controls."""
    gui = page.server.gui
    with gui.add_folder("Save"):
        buttons = {
            suffix: gui.add_button(label, hint=hint)
            for suffix, label, hint in (
                (".png", "PNG", "The view as it is shown, 16 samples a pixel, with its camera beside it."),
                (".exr", "EXR", "Linear radiance and alpha, or the variable, with its camera beside it."),
                (CAMERA, "Camera", "A transforms file of this one view."),
            )
        }
        saved = gui.add_markdown(f"into {page.views_folder}")

    def save(suffix: str, number: int) -> None:
        visitor = page.loop.visitors.get(number)
        if visitor is None or visitor.pose is None:
            return
        path = write_view(
            page.drawable, visitor.pose, visitor.window, visitor.look, page.views_folder, suffix
        )
        saved.content = f"saved {path}"

    for suffix, button in buttons.items():

        @button.on_click
        def _(event: Any, suffix: str = suffix) -> None:
            number = event.client.client_id
            page.loop.ask(("save", suffix, number), lambda: save(suffix, number), changes=False)


def write_view(
    drawable: ViewerScene,
    pose: Pose,
    window: tuple[int, int],
    look: DisplayOptions,
    folder: Path,
    suffix: str,
) -> Path:
    """Write the next numbered view in a folder, and its camera; returns the path of the picture, or of that.

    Raises InputError if it cannot be written.
    """
    make_folder(folder)
    camera = write_camera(folder, lambda stem: json.dumps(pose.transforms(*window, stem), indent=1) + "\n")
    picture = camera.with_suffix(suffix)
    if suffix != CAMERA:
        try:
            write_picture(picture, drawable.fine(pose, *window, look), window, look)
        except BaseException:
            camera.unlink(missing_ok=True)
            raise
    return picture


def write_camera(folder: Path, content: Callable[[str], str]) -> Path:
    """Write the file that takes the next number, and its text for that name; other files stay as they are.

    Whoever creates the file first has the number, so two viewers may save into one folder. Raises InputError
    if it cannot be written.
    """
    stems = {path.name.partition(".")[0] for path in folder.iterdir()}
    number = max((int(stem[5:]) for stem in stems if NUMBERED.fullmatch(stem)), default=-1)
    while True:
        number += 1
        path = folder / f"view_{number:03d}{CAMERA}"
        if path.stem in stems:
            continue
        try:
            with path.open("x", encoding="utf-8") as file:
                file.write(content(path.stem))
        except FileExistsError:
            continue
        except OSError as error:
            raise cannot_write(path, error) from error
        return path


def write_picture(path: Path, planes: list[Any], window: tuple[int, int], look: DisplayOptions) -> None:
    """Write planes of `develop.planes_of` as PNG, as they are shown, or as EXR, linear."""
    straight = look.what == IMAGE and len(planes) == 4  # nothing of its own behind it
    if path.suffix == ".exr":
        values, coverage = seen_of(planes, look), planes[-1]
        if look.what == IMAGE:
            planes = values
        elif look.what in (*TERMS, "alpha"):
            planes = [*values, coverage]
        else:
            planes = [*(value * coverage for value in values), coverage]
        names = {2: "YA", 4: "RGBA"}[len(planes)]
        write_exr(path, stacked(planes, window), names)
    elif straight:
        rgba = stacked(planes, window)
        rgba[..., :3] *= np.float32(2.0**look.exposure)
        write_png(path, straight_srgb(rgba))
    else:
        write_png(path, stacked(shown_planes(planes, look), window))


def stacked(planes: list[Any], window: tuple[int, int]) -> np.ndarray:
    """Planes as an array (H, W, C) float32."""
    width, height = window
    full = [np.broadcast_to(np.array(plane, np.float32).ravel(), width * height) for plane in planes]
    return np.stack(full, axis=-1).reshape(height, width, len(planes))
