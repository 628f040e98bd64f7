"""The region of interest: displayed as a wireframe, moved, resized, and saved for the next fit."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.region import REGION_FILE, Region, read_region, write_region
from mi_refgs.errors import InputError
from mi_refgs.io.progress import command_line
from mi_refgs.viewer.page import Page

RADII, STEPS = (0.1, 3.0), 100  # limits of the slider, in the first radius, and steps of a slider per radius


class RegionPanel:
    """The controls of the region of interest."""

    def __init__(self, page: Page, data: Dataset, region: Region) -> None:
        """Add the controls, which begin with a region of a data set."""
        self.page, self.data, self.first, self.saved = page, data, region, False
        gui, radius = page.server.gui, region.radius
        with gui.add_folder("Region of interest", expand_by_default=False):
            self.show = gui.add_checkbox("Border", False, hint="Display it, and arrows that move its centre.")
            low, high = (factor * radius for factor in RADII)
            self.radius = gui.add_slider("Radius", low, high, radius / STEPS, radius, hint="Scene units.")
            hint = "Raises the plane that supports the object, scene units."
            names = [f"Plane {i + 1}" for i in range(len(region.supports))]
            bounds = (-radius, radius, radius / STEPS, 0.0)
            self.heights = [gui.add_slider(name, *bounds, hint=hint) for name in names]
            save = gui.add_button("Save region", hint=f"As {REGION_FILE} of the data set, for the next fit.")
            self.note = gui.add_markdown("")
        arrows = {"scale": 0.5 * radius, "disable_rotations": True, "depth_test": False, "visible": False}
        add_arrows, centre = page.server.scene.add_transform_controls, np.array(region.centre)
        self.arrows = add_arrows("/region/centre", position=centre, **arrows)
        self.lines: Any = None
        for control in (self.show, self.radius, *self.heights, self.arrows):
            control.on_update(lambda _: page.loop.submit("region", self.update, changes=False))
        save.on_click(lambda _: page.loop.submit("save region", self.save, changes=False))
        self.update()

    @property
    def region(self) -> Region:
        """The displayed one."""
        heights = [float(slider.value) for slider in self.heights]
        return adjusted(self.first, self.arrows.position, float(self.radius.value), heights)

    def update(self) -> None:
        """Display the region as the controls say."""
        region = self.region
        centre = ", ".join(f"{x:.4g}" for x in region.centre)
        self.note.content = f"centre ({centre}), radius {region.radius:.4g}"
        self.arrows.visible = self.show.value
        if self.show.value:
            mesh, add_mesh = border(region), self.page.server.scene.add_mesh_simple
            shape = (mesh.vertices, mesh.faces)
            self.lines = add_mesh("/region/border", *shape, color=(120, 230, 120), wireframe=True)
        elif self.lines is not None:
            self.lines.visible = False

    def save(self) -> None:
        """Write the region, as `save_region` does."""
        self.note.content = save_region(self.region, self.data, self.saved)
        self.saved = True


def save_region(region: Region, data: Dataset, again: bool = False) -> str:
    """Write a region in the coordinates of a data set's files; return what the user does next. Raises
    InputError for a region.json that is there, unless it is an estimate or this page saves it `again`."""
    there = read_region(data.path)
    if there is not None and not (there.estimated or again):
        remedy = "move it away, or correct it by hand"
        raise InputError("exists, and is no estimate", data.path / REGION_FILE, "output", remedy)
    write_region(data.path, replace(region, estimated=False).moved(np.array(data.offset)))
    return f"saved `{data.path / REGION_FILE}`; next: `{command_line('train', data.path, '-o', 'RUN')}`"


def adjusted(region: Region, centre: np.ndarray, radius: float, heights: Sequence[float]) -> Region:
    """A region with another centre (3,) and radius, its support planes raised by scene units."""
    planes = [(a, b, c, d + up) for (a, b, c, d), up in zip(region.planes, heights, strict=False)]
    for a, b, c, d in region.planes[len(heights) :]:
        inward = d - float(np.dot((a, b, c), region.centre))
        planes.append((a, b, c, float(np.dot((a, b, c), centre)) + radius / region.radius * inward))
    return Region(tuple(map(float, centre)), radius, tuple(planes))


def border(region: Region) -> trimesh.Trimesh:
    """Return the border of a region, which is convex: its sphere, cut by its planes."""
    sphere = trimesh.creation.icosphere(3, region.radius)
    vertices, faces = np.add(sphere.vertices, region.centre), sphere.faces
    for *normal, distance in region.planes:
        at = np.multiply(normal, distance)
        vertices, faces, _ = trimesh.intersections.slice_faces_plane(vertices, faces, normal, at)
    mesh = trimesh.Trimesh(vertices, faces)
    return mesh.convex_hull if len(faces) else mesh
