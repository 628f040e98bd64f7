"""Painting of an object on the displayed views, and masks of it for the data set."""

from __future__ import annotations

import itertools
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.images import MASKS
from mi_refgs.editing.painting import Painting
from mi_refgs.errors import InputError
from mi_refgs.viewer import resolution
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import ReconstructionView

ADD, REMOVE = "shift", "cmd/ctrl"
"""Keys that paint, and that remove, while the mouse is clicked or dragged."""
SIDE = 400
"""Resolution level of the painted views."""
BRUSHES = (0.01, 0.2, 0.03)
"""Smallest, largest and first radius of the brush, in heights of the window."""

WriteMasks = Callable[[np.ndarray, Path | None], list[Path]]
"""Writes masks of surfels (N,) bool into a folder, None: the data set; returns the files."""


class PaintingPanel:
    """The controls, and what is painted."""

    def __init__(self, page: Page, scene: ReconstructionView, data: Dataset, write_masks: WriteMasks) -> None:
        """Add the controls of a scene that was fitted to a data set."""
        self.page, self.scene, self.write_masks = page, scene, write_masks
        self.next = f"; next: `refgs train {shlex.quote(str(data.path))} -o RUN`"
        self.painting = Painting(scene.original)
        gui, submit, strokes = page.server.gui, page.loop.submit, itertools.count()
        with gui.add_folder("Masks", expand_by_default=False):
            text = (
                "Paint the object: Shift and drag a rectangle, or Shift and click. Ctrl removes. Then turn "
            )
            gui.add_markdown(f"{text}the camera and correct other sides.")
            low, high, first = BRUSHES
            self.brush = gui.add_slider(
                "Brush", low, high, low, first, hint="Radius of a click, in heights of the window."
            )
            undo = gui.add_button("Undo")
            hint = f"Its folder {MASKS} gets them; empty: the data set."
            self.folder = gui.add_text("Masks into", "", hint=hint)
            write = gui.add_button("Write masks")
            self.note = gui.add_markdown("Nothing is painted.")

        scene_api = page.server.scene
        for key in (ADD, REMOVE):

            @scene_api.on_click(modifier=key)
            def _(event: Any, key: str = key) -> None:
                self._submit(next(strokes), event, (event.screen_pos, event.screen_pos), key)

            @scene_api.on_rect_select(modifier=key)
            def _(event: Any, key: str = key) -> None:
                self._submit(next(strokes), event, (event.screen_min, event.screen_max), key)

        undo.on_click(lambda _: submit(("stroke", next(strokes)), self.undo))
        write.on_click(lambda _: submit("masks", self.write, changes=False))

    def _submit(self, number: int, event: Any, corners: Any, key: str) -> None:
        """Queue a stroke of a page, a click or a rectangle."""
        client = self.page.loop.clients.get(event.client_id)
        if client is not None and client.pose is not None:
            pose, window, low, high = client.pose, client.window, *(np.array(xy) for xy in corners)
            paint = lambda: self.paint(pose, window, low, high, remove=key == REMOVE)  # noqa: E731
            self.page.loop.submit(("stroke", number), paint)

    def paint(
        self, pose: Pose, window: tuple[int, int], low: np.ndarray, high: np.ndarray, *, remove: bool
    ) -> None:
        """Paint a rectangle with corners (2,), 0 … 1 from the upper left one; one point: with the brush."""
        aspect = window[0] / window[1]
        width, height = resolution.size_of(SIDE, resolution.shape_of(*window))
        xy = np.stack(np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height), -1)
        if (low == high).all():
            mask = np.linalg.norm((xy - low) * (aspect, 1), axis=-1) < self.brush.value
        else:
            mask = ((xy >= low) & (xy <= high)).all(axis=-1)
        self.painting.paint(replace(pose, aspect=aspect).camera(width, height), mask, remove=remove)
        self._update()

    def undo(self) -> None:
        """Undo the last stroke."""
        self.painting.undo()
        self._update()

    def write(self) -> None:
        """Write the masks; raises InputError if nothing is painted, and as `formats.write` does."""
        chosen, folder = self.painting.surfels(), self.folder.value.strip()
        if not chosen.any():
            raise InputError("masks: nothing is painted; paint the object first")
        files = self.write_masks(chosen, Path(folder) if folder else None)
        self.note.content = f"wrote {len(files)} masks, such as `{files[0]}`{'' if folder else self.next}"

    def _update(self) -> None:
        chosen = self.painting.surfels()
        self.scene.highlighted = chosen if chosen.any() else None
        self.note.content = f"{int(chosen.sum()):,} of {len(chosen):,} surfels"
