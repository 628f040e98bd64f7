"""Sliders that set materials of the surfels that an expression selects."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.viewer.edits import mean_of, selected, with_material
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.reconstruction_view import Change, ReconstructionView

STEP = 0.01
PUNCTUATION = re.compile(r"([\\`*_{}\[\]<>#])")
"""What has a meaning in Markdown."""


def add(page: Page, scene: ReconstructionView) -> None:
    """Add the controls; nothing for a scene without materials."""
    if scene.materials:
        Materials(page, scene)


def escaped(text: str) -> str:
    """Plain text as the page's Markdown."""
    return PUNCTUATION.sub(r"\\\1", text)


class Materials:
    """The selection, and what is set on it; what was set on earlier ones stays."""

    def __init__(self, page: Page, scene: ReconstructionView) -> None:
        self.page, self.scene = page, scene
        self.done: list[Change] = []  # of earlier selections
        self.values: dict[str, float] = {}  # of the present one
        self.mask = np.ones(scene.original.surfels.count, bool)
        self.quiet = False  # sliders are being set to what is selected
        gui = page.server.gui
        with gui.add_folder("Materials"):
            self.where = gui.add_text(
                "Where",
                "",
                hint="An expression over channels, such as `metallic > 0.5 and z < 0`; empty: all surfels.",
            )
            self.count = gui.add_markdown(self._counted())
            self.sliders = {
                name: gui.add_slider(name.capitalize(), 0.0, 1.0, STEP, self._mean(name))
                for name in scene.materials
            }
            reset = gui.add_button("As fitted")

        for name, slider in self.sliders.items():

            @slider.on_update
            def _(_: Any, name: str = name) -> None:
                if not self.quiet:
                    page.loop.ask(("material", name), lambda: self.set(name))

        self.where.on_update(lambda _: page.loop.ask("where", self.select, changes=False))
        reset.on_click(lambda _: page.loop.ask("reset", self.reset))

    def set(self, name: str) -> None:
        """Set a material of the selection to its slider's value."""
        self.values[name] = float(self.sliders[name].value)
        self.scene.set_changes([*self.done, self._change()])

    def select(self) -> None:
        """Select what the expression says; what is wrong with it stands below it, as it may be half typed."""
        try:
            mask = selected(self.where.value, self.scene.original)
        except InputError as error:
            said = str(error).removeprefix("--where: ")
            self.count.content = f"{escaped(said)} (still {self._counted()})"
            return
        if self.values:
            self.done.append(self._change())
        self.mask, self.values = mask, {}
        self._follow()

    def reset(self) -> None:
        """Everything as it was fitted."""
        self.done, self.values = [], {}
        self.scene.set_changes([])
        self._follow()

    def _change(self) -> Change:
        mask, values = self.mask, dict(self.values)
        return lambda scene: with_material(scene, mask, values)

    def _follow(self) -> None:
        """Show what is selected."""
        self.count.content = self._counted()
        self.quiet = True
        for name, slider in self.sliders.items():
            slider.value = self._mean(name)
        self.quiet = False

    def _mean(self, name: str) -> float:
        return round(mean_of(self.scene.scene, self.mask, name) / STEP) * STEP

    def _counted(self) -> str:
        return f"{int(self.mask.sum()):,} of {len(self.mask):,} surfels"
