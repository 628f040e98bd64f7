"""The region of interest: displayed as a wireframe, moved, resized, and saved for the next fit."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import REGION_FILE, Plane, Region
from mi_refgs.io.files import write_json
from mi_refgs.io.ownership import OutputFolder, require_no_run
from mi_refgs.viewer.page import Page

OWNER = "view"
"""Owner of the region.json that a page writes into a data set."""
RADII = (0.1, 3.0)
"""Smallest and largest radius of the slider, in the first radius."""
STEPS = 100
"""Steps per radius of the sliders."""
OPPOSITE = 1e-6
"""Difference of unit normals up to which planes are opposite sides of a box."""

MERIDIANS, PARALLELS, LINES = 6, 5, 7
"""Circles of the sphere's wireframe, and lines on a plane along each axis."""
POINTS = 49
"""Points of each."""
COLOUR = (120, 230, 120)
THICKNESS = 1.5
"""Width of its lines, pixels."""


class RegionPanel:
    """The controls of the region of interest."""

    def __init__(self, page: Page, data: Dataset, region: Region) -> None:
        """Add the controls, which begin with a region of a data set."""
        self.page, self.data, self.first = page, data, region
        gui, radius = page.server.gui, region.radius
        with gui.add_folder("Region of interest", expand_by_default=False):
            self.show = gui.add_checkbox("Border", False, hint="Display it, and arrows that move its centre.")
            low, high = (factor * radius for factor in RADII)
            self.radius = gui.add_slider("Radius", low, high, radius / STEPS, radius, hint="Scene units.")
            hint = "Raises the plane that supports the object, scene units."
            self.heights = [
                gui.add_slider(f"Plane {i}", -radius, radius, radius / STEPS, 0.0, hint=hint)
                for i in range(1, 1 + len(support_planes(region.planes)))
            ]
            hint = f"The file to write, which is replaced; empty: {REGION_FILE} of the data set."
            self.file = gui.add_text("Region file", "", hint=hint)
            save = gui.add_button("Save region")
            self.note = gui.add_markdown("")
        self.arrows = page.server.scene.add_transform_controls(
            "/region/centre",
            scale=0.5 * radius,
            disable_rotations=True,
            depth_test=False,
            position=np.array(region.centre),
            visible=False,
        )
        self.lines: Any = None
        for control in (self.show, self.radius, *self.heights, self.arrows):
            control.on_update(lambda _: page.loop.submit("region", self.update, changes=False))
        save.on_click(lambda _: page.loop.submit("save region", self.save, changes=False))
        self.update()

    @property
    def region(self) -> Region:
        """The region that is displayed."""
        heights = [float(slider.value) for slider in self.heights]
        return adjusted(self.first, self.arrows.position, float(self.radius.value), heights)

    def update(self) -> None:
        """Display the region as the controls say."""
        region = self.region
        centre = ", ".join(f"{x:.4g}" for x in region.centre)
        self.note.content = f"centre ({centre}), radius {region.radius:.4g}"
        self.arrows.visible = self.show.value
        if self.show.value:
            self.lines = self.page.server.scene.add_line_segments(
                "/region/border", wireframe(region), COLOUR, thickness=THICKNESS, thickness_units="screen"
            )
        elif self.lines is not None:
            self.lines.visible = False
        self.page.overlay("region", self.show.value)

    def save(self) -> None:
        """Write the region; raises InputError as `save_region` does."""
        file = self.file.value.strip()
        self.note.content = save_region(self.region, self.data, Path(file) if file else None)


def save_region(region: Region, data: Dataset, file: Path | None = None) -> str:
    """Write a region in the coordinates of a data set's files; return what the user does next.

    The data set's region.json is replaced only if a page wrote it, unless `file` names it. Raises InputError
    for another one that is there, a file of a run, and one that cannot be written.
    """
    own = data.path / REGION_FILE
    if file is None:
        remedy = f"type {own} as region file to replace it, or another path"
        OutputFolder(data.path, OWNER, remedy=remedy).claim(REGION_FILE)
    else:
        require_no_run(file)
    path = file or own
    write_json(path, replace(region, estimated=False).moved(np.array(data.offset)).content)
    command = f"refgs train {shlex.quote(str(data.path))} -o RUN"
    if path.resolve() == own.resolve():
        return f"saved `{path}`; next: `{command}`"
    return f"saved `{path}`; next: move it to `{own}`, then `{command}`"


def support_planes(planes: Sequence[Plane]) -> Sequence[Plane]:
    """Return the planes without the box around a fitted object: the last three pairs of `fitted_region`."""
    normals = np.array(planes).reshape(-1, 4)[-2 * 3 :, :3]
    is_box = len(normals) == 2 * 3 and np.abs(normals[:3] + normals[3:]).max() < OPPOSITE
    return planes[: -2 * 3] if is_box else planes


def adjusted(region: Region, centre: np.ndarray, radius: float, heights: Sequence[float]) -> Region:
    """Return a region with another centre (3,) and radius, and each support plane raised by scene units.

    The box around a fitted object moves and grows with the sphere.
    """
    planes = [(a, b, c, d + up) for (a, b, c, d), up in zip(region.planes, heights, strict=False)]
    for a, b, c, d in region.planes[len(heights) :]:
        inward = d - float(np.dot((a, b, c), region.centre))
        planes.append((a, b, c, float(np.dot((a, b, c), centre)) + radius / region.radius * inward))
    x, y, z = map(float, centre)
    return Region((x, y, z), radius, tuple(planes))


def wireframe(region: Region) -> np.ndarray:
    """Return line segments (S, 2, 3) on the border of a region, on its sphere and on its planes."""
    angle = np.linspace(0, 2 * np.pi, POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros(POINTS)], axis=-1)
    centre = np.array(region.centre)

    # Circles of the sphere.
    curves = []
    for latitude in np.pi * ((np.arange(PARALLELS) + 1) / (PARALLELS + 1) - 0.5):
        curves.append(np.cos(latitude) * circle + (0, 0, np.sin(latitude)))
    for turn in np.pi * np.arange(MERIDIANS) / MERIDIANS:
        across = np.array([np.cos(turn), np.sin(turn), 0])
        curves.append(circle[:, :1] * across + circle[:, 1:2] * (0, 0, 1))
    found = [_segments(centre + region.radius * np.array(curves), region)]

    # For each plane, the circle in which the sphere ends, and a grid of lines inside.
    for plane in region.planes:
        normal = np.array(plane[:3])
        below = float(normal @ centre) - plane[3]
        if abs(below) >= region.radius:
            continue
        rest = replace(region, planes=tuple(other for other in region.planes if other != plane))
        wide = np.sqrt(region.radius**2 - below**2)
        first, second = np.linalg.svd(normal[None])[2][1:]
        at = np.linspace(-1, 1, LINES + 2)[1:-1, None]
        along = np.linspace(-1, 1, POINTS) * np.sqrt(1 - at**2)
        u = np.concatenate([circle[None, :, 0], along, np.broadcast_to(at, along.shape)])
        v = np.concatenate([circle[None, :, 1], np.broadcast_to(at, along.shape), along])
        on = centre - below * normal
        found.append(_segments(on + wide * (u[..., None] * first + v[..., None] * second), rest))
    return np.concatenate(found)


def _segments(curves: np.ndarray, region: Region) -> np.ndarray:
    """Return the segments (S, 2, 3) of curves (C, P, 3) whose ends are above the planes of a region."""
    pairs = np.stack([curves[:, :-1], curves[:, 1:]], axis=2).reshape(-1, 2, 3)
    return pairs[region.above(pairs).all(axis=1)]
