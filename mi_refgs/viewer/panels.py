"""Panels of controls: display options, light, materials, overlays."""

from __future__ import annotations

import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.editing.change import apply
from mi_refgs.editing.options import Change, Selection
from mi_refgs.editing.placement import object_mesh
from mi_refgs.editing.selection import select
from mi_refgs.errors import InputError
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.attributes import sigmoid
from mi_refgs.viewer.mitsuba_scene import MitsubaScene
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import Change as SceneChange
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.resolution import FINEST, SIDES

STOPS = 6.0
"""Largest exposure either way."""
AUTOMATIC = "automatic"

IMAGES = ".exr,.hdr"
"""File name endings that the page offers; PNG and JPEG files are read, too."""
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
"""Passes a file that is dropped anywhere on the page to the upload button: viser has no drop target, and runs
no script of a page except in an event handler."""

STEP = 0.01
"""Step of the sliders of materials."""
PUNCTUATION = re.compile(r"([\\`*_{}\[\]<>#])")
"""What has a meaning in Markdown."""

FRUSTUM = 0.08
"""Size of a camera's frustum, in radii of the object."""
THICKNESS = 1.5
"""Thickness of its lines, pixels."""
COLOURS = {"train": (90, 160, 255), "test": (255, 160, 60)}
"""Colours of the frusta by split."""
MESH_COLOUR, MESH_OPACITY = (200, 200, 205), 0.55


def add_display(page: Page) -> None:
    """Add the status line and the controls of what is displayed, and at which resolution."""
    gui = page.server.gui
    status = gui.add_markdown("starting")
    page.status = lambda text: setattr(status, "content", text)
    sizes = {f"{side}²": side for side in SIDES}
    with gui.add_folder("View"):
        what = gui.add_dropdown("Show", page.scene.variables, hint="The image, or one of its AOVs.")
        exposure = gui.add_slider("Exposure", -STOPS, STOPS, 0.25, 0.0, hint="Stops.")
        backdrop = gui.add_dropdown("Backdrop", page.scene.backdrops, hint="What is behind the object.")
        hint = "Pixels during motion; automatic: as many as can be drawn 20 times per second."
        moving = gui.add_dropdown("Moving", (AUTOMATIC, *sizes), hint=hint)
        still = gui.add_dropdown("Still", [*sizes], initial_value=f"{FINEST}²", hint="Most pixels at rest.")
    what.on_update(lambda _: page.set(what=what.value))
    backdrop.on_update(lambda _: page.set(backdrop=backdrop.value))
    exposure.on_update(lambda _: page.set(exposure=float(exposure.value)))
    moving.on_update(lambda _: page.set(fixed=sizes.get(moving.value)))
    still.on_update(lambda _: page.set(largest=sizes[still.value]))


# ---------------- light ----------------


def add_light(page: Page, scene: ReconstructionView | MitsubaScene) -> None:
    """Add the rotation of the light, and for a reconstruction its replacement; none without a light."""
    if not scene.can_turn:
        return
    gui, submit = page.server.gui, page.loop.submit
    folder = gui.add_folder("Light")
    with folder:
        turn = gui.add_slider("Turn", 0.0, 360.0, 1.0, 0.0, hint="Degrees about the vertical axis.")
    turn.on_update(lambda _: submit("turn", lambda: scene.set_turn(turn.value)))
    if not isinstance(scene, ReconstructionView):
        return
    with folder:
        hint = "A lat-long image (EXR, HDR) whose first row is straight up."
        upload = gui.add_upload_button("Upload or drop an HDRI", mime_type=IMAGES, hint=hint)
        hint = "Like environment.exr and envmap.exr."
        world = gui.add_checkbox("Map has world directions", False, hint=hint)
        own = gui.add_button("Estimated environment map")
        if scene.can_relight:
            hint = "Replaces fitted colours by materials and traces shadows, as `refgs relight` does."
            relit = gui.add_checkbox("Light changes colours", False, hint=hint)
            relit.on_update(lambda _: submit("relit", lambda: scene.set_relit(relit.value)))
        gui.add_html(DROP)

    @upload.on_upload
    def _(_: Any) -> None:
        name, content = upload.value.name, upload.value.content

        def replace_light() -> None:
            scene.set_light(light_of(name, content, world.value))
            page.notify("Light", name)

        submit("light", replace_light)

    @own.on_click
    def _(_: Any) -> None:
        turn.value = 0.0
        submit("turn", lambda: scene.set_turn(0.0))
        submit("light", lambda: scene.set_light(None))


def light_of(name: str, content: bytes, world: bool) -> EnvironmentLight:
    """Read the light of an uploaded image file; raises InputError, with its name, if it cannot be read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "light"  # its format is decided by its first bytes
        path.write_bytes(content)
        try:
            return NewLight(path, world).read()
        except InputError as error:
            raise InputError(error.what, name, error.field, error.remedy) from error


# ---------------- materials ----------------


class MaterialsPanel:
    """A selection and sliders for its materials; what was set on earlier selections stays."""

    def __init__(self, page: Page, scene: ReconstructionView) -> None:
        """Add the controls."""
        self.scene = scene
        self.done = scene.changes  # of earlier selections
        self.values: dict[str, float] = {}  # set on the present one
        self.mask = np.ones(scene.original.surfels.count, bool)
        self.quiet = False  # sliders are being set to the selection's values
        gui, submit = page.server.gui, page.loop.submit
        with gui.add_folder("Materials"):
            hint = "An expression such as `metallic > 0.5 and z < 0`; empty: all surfels."
            self.where = gui.add_text("Where", "", hint=hint)
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
                    submit(("material", name), lambda: self.set(name))

        self.where.on_update(lambda _: submit("where", self.select, changes=False))
        reset.on_click(lambda _: submit("reset", self.reset))

    def set(self, name: str) -> None:
        """Set a material of the selection to its slider's value."""
        self.values[name] = float(self.sliders[name].value)
        self.scene.set_changes([*self.done, self._change()])

    def select(self) -> None:
        """Select by the expression; an error is displayed below it, as it may be half typed."""
        where = self.where.value.strip()
        try:
            mask = select(self.scene.original, Selection(where=where or None))
        except InputError as error:
            said = PUNCTUATION.sub(r"\\\1", str(error).removeprefix("--where: "))
            self.count.content = f"{said} (still {self._counted()})"
            return
        self.done, self.mask, self.values = self.scene.changes, mask, {}
        self._update()

    def reset(self) -> None:
        """Restore all fitted materials."""
        self.done, self.values = [], {}
        self.scene.set_changes([])
        self._update()

    def _change(self) -> SceneChange:
        mask, change = self.mask, Change(set=dict(self.values))
        return lambda scene: apply(scene, mask, change)

    def _update(self) -> None:
        """Let the controls display the selection."""
        self.count.content = self._counted()
        self.quiet = True
        for name, slider in self.sliders.items():
            slider.value = self._mean(name)
        self.quiet = False

    def _mean(self, name: str) -> float:
        raw = self.scene.scene.surfels.to_numpy()[name]
        return round(float(sigmoid(raw[self.mask, 0]).mean()) / STEP) * STEP

    def _counted(self) -> str:
        return f"{int(self.mask.sum()):,} of {len(self.mask):,} surfels"


# ---------------- overlays ----------------


def add_overlays(page: Page, scene: TrainedScene | None) -> None:
    """Add the mesh of a scene and the cameras of the data set, which the browser draws over the image."""
    gui = page.server.gui
    meshed = scene is not None and scene.mesh is not None and len(scene.mesh.faces) > 0
    if not meshed and not page.views:
        return
    with gui.add_folder("Overlays"):
        if scene is not None and meshed:
            add_mesh(page, gui.add_checkbox("Mesh", False, hint="The occluder of reflections."), scene)
        if page.views:
            add_cameras(page, gui.add_checkbox("Cameras", False, hint="Blue: training, orange: test."))


def add_mesh(page: Page, box: Any, scene: TrainedScene) -> None:
    """Display the mesh while a checkbox is ticked, without the background's where that is not displayed."""
    nodes: dict[bool, Any] = {}

    def show() -> None:
        object_only = page.loop.look.object_only and scene.surroundings is not None
        if box.value and object_only not in nodes:
            mesh = object_mesh(scene) if object_only else scene.mesh
            if mesh is None or not len(mesh.faces):
                return
            nodes[object_only] = page.server.scene.add_mesh_simple(
                f"/mesh_{'object' if object_only else 'all'}",
                mesh.vertices,
                mesh.faces,
                color=MESH_COLOUR,
                opacity=MESH_OPACITY,
                flat_shading=True,
                side="double",
                cast_shadow=False,
                receive_shadow=False,
            )
        for each, node in nodes.items():
            node.visible = box.value and each == object_only

    page.look_changed = lambda: page.loop.submit("mesh", show, changes=False)
    box.on_update(lambda _: page.look_changed())


def add_cameras(page: Page, box: Any) -> None:
    """Display the frusta of all cameras while a checkbox is ticked; they are made when it first is."""
    nodes: list[Any] = []

    @box.on_update
    def _(_: Any) -> None:
        if box.value and not nodes:
            for split, data in page.data.items():
                for index, view in enumerate(data.views):
                    pose = Pose.of_view(view)
                    node = page.server.scene.add_camera_frustum(
                        f"/cameras/{split}/{index}",
                        pose.fov,
                        pose.aspect,
                        scale=FRUSTUM * page.scene.radius,
                        thickness=THICKNESS,
                        thickness_units="screen",
                        color=COLOURS[split],
                        wxyz=pose.page_rotation,
                        position=pose.position,
                        cast_shadow=False,
                        receive_shadow=False,
                    )
                    nodes.append(node)
        for node in nodes:
            node.visible = box.value
        page.overlay("cameras", box.value)
