"""The light: turned, or swapped for an image that is uploaded or dropped onto the page."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, Protocol

from mi_refgs.errors import InputError
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.reconstruction_view import ReconstructionView

IMAGES = ".exr,.hdr"
"""Endings that the page offers; a PNG or JPEG file is read too."""

DROP = """<img alt="" src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAA=" onload="
if (!window.refgsDrop) {
  window.refgsDrop = true;
  window.addEventListener('dragover', (event) => event.preventDefault());
  window.addEventListener('drop', (event) => {
    event.preventDefault();
    const input = document.querySelector('input[type=file][accept=\\'%s\\']');
    if (!input || !event.dataTransfer.files.length) return;
    input.files = event.dataTransfer.files;
    input.dispatchEvent(new Event('change', {bubbles: true}));
  });
}" style="display:none">""" % (IMAGES,)  # noqa: UP031  (braces)
"""Hands a file that is dropped anywhere on the page to the upload button: viser has no drop target, and runs
no script of a page but through an event handler."""


class Turning(Protocol):
    """A scene whose light may turn."""

    @property
    def lit(self) -> bool:
        """Whether it has one that may."""

    def set_turn(self, degrees: float) -> None:
        """Turn it."""


def add(page: Page, scene: Turning) -> None:
    """Add the controls; nothing for a scene without a light that may turn."""
    if not scene.lit:
        return
    gui = page.server.gui
    folder = gui.add_folder("Light")
    with folder:
        turn = gui.add_slider("Turn", 0.0, 360.0, 1.0, 0.0, hint="Degrees about the vertical axis.")
    turn.on_update(lambda _: page.loop.ask("turn", lambda: scene.set_turn(turn.value)))
    if isinstance(scene, ReconstructionView):
        with folder:
            _add_swap(page, scene, turn)


def _add_swap(page: Page, scene: ReconstructionView, turn: Any) -> None:
    """What another light takes, and the way back."""
    gui = page.server.gui
    upload = gui.add_upload_button(
        "Upload or drop an HDRI",
        mime_type=IMAGES,
        hint="A lat-long image (EXR, HDR) whose first row is straight up.",
    )
    world = gui.add_checkbox(
        "Map has world directions", False, hint="As environment.exr and envmap.exr have."
    )
    own = gui.add_button("The fitted light")
    relit = None
    if scene.can_relight:
        relit = gui.add_checkbox(
            "Light changes colours",
            False,
            hint="Replaces fitted colours by materials, so that all of them follow a new light, with traced "
            "shadows, as `refgs relight` does.",
        )
    gui.add_html(DROP)

    @upload.on_upload
    def _(_: Any) -> None:
        name, content = upload.value.name, upload.value.content

        def swap() -> None:
            scene.set_light(light_of(name, content, world.value))
            page.notify("Light", name)

        page.loop.ask("light", swap)

    @own.on_click
    def _(_: Any) -> None:
        turn.value = 0.0
        page.loop.ask("turn", lambda: scene.set_turn(0.0))
        page.loop.ask("light", lambda: scene.set_light(None))

    if relit is not None:
        relit.on_update(lambda _: page.loop.ask("relit", lambda: scene.set_relit(relit.value)))


def light_of(name: str, content: bytes, world: bool) -> EnvironmentLight:
    """The light of an uploaded image file; raises InputError, with its name, for one that cannot be read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light"  # what kind it is, its first bytes say
        path.write_bytes(content)
        try:
            return NewLight(path, world).read()
        except InputError as error:
            raise InputError(str(error).replace(str(path), name)) from error
