"""The mesh and the training cameras, drawn by the page itself over the picture."""

from __future__ import annotations

from typing import Any

from mi_refgs.editing.placement import object_mesh
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose, page_rotation

FRUSTUM = 0.08
"""Size of a camera's frustum, in radii of the object."""
THICKNESS = 1.5
"""Of its lines, pixels."""
TRAINING, TEST = (90, 160, 255), (255, 160, 60)
"""Colours of cameras."""
MESH_COLOUR, MESH_OPACITY = (200, 200, 205), 0.55


def add(page: Page, scene: TrainedScene | None) -> None:
    """Add the controls, as far as there is something to show."""
    gui = page.server.gui
    meshed = scene is not None and scene.mesh is not None and len(scene.mesh.faces) > 0
    if not meshed and not page.views.all:
        return
    with gui.add_folder("Overlays"):
        if scene is not None and meshed:
            shown = gui.add_checkbox("Mesh", False, hint="The occluder of reflections.")
            follows(page, shown, scene)
        if page.views.all:
            cameras = gui.add_checkbox("Cameras", False, hint="Blue: training, orange: test.")
            toggles(cameras, lambda: add_cameras(page))
            cameras.on_update(lambda _: page.set(depth=cameras.value))


def toggles(box: Any, make: Any) -> None:
    """Nodes that are made when a box is first ticked, and shown while it is."""
    nodes: list[Any] = []

    @box.on_update
    def _(_: Any) -> None:
        if box.value and not nodes:
            nodes.extend(make())
        for node in nodes:
            node.visible = box.value


def follows(page: Page, box: Any, scene: TrainedScene) -> None:
    """The mesh while a box is ticked: all of it, or the object's own while that is shown alone."""
    nodes: dict[bool, Any] = {}

    def show() -> None:
        alone = page.look.object_only and scene.surroundings is not None
        if box.value and alone not in nodes:
            mesh = object_mesh(scene) if alone else scene.mesh
            if mesh is None or not len(mesh.faces):
                return
            nodes[alone] = add_mesh(page, f"/mesh_{'object' if alone else 'all'}", mesh)
        for each, node in nodes.items():
            node.visible = box.value and each == alone

    page.looked = lambda: page.loop.ask("mesh", show, changes=False)
    box.on_update(lambda _: page.looked())


def add_mesh(page: Page, name: str, mesh: Mesh) -> Any:
    """The node of a mesh."""
    return page.server.scene.add_mesh_simple(
        name,
        mesh.vertices,
        mesh.faces,
        color=MESH_COLOUR,
        opacity=MESH_OPACITY,
        flat_shading=True,
        side="double",
        cast_shadow=False,
        receive_shadow=False,
    )


def add_cameras(page: Page) -> list[Any]:
    """The nodes of all cameras."""
    nodes = []
    for split, data, colour in (("train", page.views.train, TRAINING), ("test", page.views.test, TEST)):
        for index, view in enumerate(data.views if data is not None else ()):
            pose = Pose.of_view(view)
            nodes.append(
                page.server.scene.add_camera_frustum(
                    f"/cameras/{split}/{index}",
                    pose.fov,
                    pose.aspect,
                    scale=FRUSTUM * page.drawable.radius,
                    thickness=THICKNESS,
                    thickness_units="screen",
                    color=colour,
                    wxyz=page_rotation(pose),
                    position=pose.position,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
    return nodes
