"""Panels of controls: display options, light, materials, cameras; saving of views."""

import itertools
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.editing.change import apply, assignments
from mi_refgs.editing.options import Selection
from mi_refgs.editing.selection import select
from mi_refgs.errors import InputError
from mi_refgs.io.exr import write_exr
from mi_refgs.io.files import write_json
from mi_refgs.io.images import straight_srgb, write_png
from mi_refgs.plugins.aovs import values_of_planes
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.render.display import image_array
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.attributes import sigmoid
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import (
    IMAGE,
    DisplayOptions,
    ReconstructionView,
    displayed_planes,
    planes_of,
)
from mi_refgs.viewer.resolution import FINEST, SAMPLES, SIDES

STOPS = 6.0  # largest exposure either way
COLOURS = {"train": (90, 160, 255), "test": (255, 160, 60)}  # colours of the frusta by split


def add_display(page: Page) -> None:
    """Add the status line and the controls of what is displayed, and at which resolution."""
    gui, display = page.server.gui, page.loop.display
    status = gui.add_markdown("starting")
    page.status = lambda text: setattr(status, "content", text)
    sizes = {f"{side}²": side for side in SIDES}
    with gui.add_folder("View"):
        what = gui.add_dropdown("Show", page.scene.variables, hint="The image, or one of its AOVs.")
        exposure = gui.add_slider("Exposure", -STOPS, STOPS, 0.25, 0.0, hint="Stops.")
        backdrop = gui.add_dropdown("Backdrop", page.scene.backdrops, hint="What is behind the object.")
        still = gui.add_dropdown("Still", [*sizes], initial_value=f"{FINEST}²", hint="Most pixels at rest.")
    what.on_update(lambda _: display(what=what.value))
    backdrop.on_update(lambda _: display(backdrop=backdrop.value))
    exposure.on_update(lambda _: display(exposure=float(exposure.value)))
    still.on_update(lambda _: display(largest=sizes[still.value]))


def add_light(page: Page, scene: ReconstructionView) -> None:
    """Add the rotation of the light and its replacement; nothing for a scene without a light."""
    if not scene.can_turn:
        return
    gui, submit = page.server.gui, page.loop.submit
    with gui.add_folder("Light"):
        turn = gui.add_slider("Turn", 0.0, 360.0, 1.0, 0.0, hint="Degrees about the vertical axis.")
        hint = "A lat-long image (EXR, HDR) whose first row is straight up."
        upload = gui.add_upload_button("Upload an HDRI", mime_type=".exr,.hdr", hint=hint)
        hint = "Like environment.exr and envmap.exr."
        world = gui.add_checkbox("Map has world directions", False, hint=hint)
        own = gui.add_button("Estimated environment map")
        if scene.can_relight:
            hint = "Replaces fitted colours by materials and traces shadows, as `refgs relight` does."
            relit = gui.add_checkbox("Light changes colours", False, hint=hint)
            relit.on_update(lambda _: submit("relit", lambda: scene.set_relit(relit.value)))
    turn.on_update(lambda _: submit("turn", lambda: scene.set_turn(turn.value)))

    @upload.on_upload
    def _(_: Any) -> None:
        name, content = upload.value.name, upload.value.content
        submit("light", lambda: scene.set_light(light_of(name, content, world.value)))

    @own.on_click
    def _(_: Any) -> None:
        turn.value = 0.0  # its callback turns the light
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


class MaterialsPanel:
    """A selection of surfels, and sliders that replace its materials."""

    def __init__(self, page: Page, scene: ReconstructionView) -> None:
        self.scene, self.mask = scene, np.ones(scene.original.surfels.count, bool)
        self.values: dict[str, float] = {}  # that replace those of the selection
        gui, self.submit = page.server.gui, page.loop.submit
        with gui.add_folder("Materials"):
            hint = "An expression such as `metallic > 0.5 and z < 0`; empty: all surfels."
            self.where = gui.add_text("Where", "", hint=hint)
            self.note = gui.add_markdown(self._counted())
            values = (0, 1, 0.01, 0)
            self.sliders = {name: gui.add_slider(name.capitalize(), *values) for name in scene.materials}
            reset = gui.add_button("As fitted")
        for name, slider in self.sliders.items():
            slider.on_update(partial(self._moved, name))
        self.where.on_update(lambda _: self.submit("where", self.select))
        reset.on_click(lambda _: self.submit("where", self.select))
        self.select()

    def _moved(self, name: str, event: Any) -> None:
        def change_material() -> None:
            self.values[name] = float(self.sliders[name].value)
            mask, made = self.mask, assignments(self.values)
            self.scene.set_change(lambda scene: apply(scene, mask, made))

        if event.client:  # by a user
            self.submit(("material", name), change_material)

    def select(self) -> None:
        """Select by the expression, as fitted; an error is displayed below it, as it may be half typed."""
        try:
            self.mask = select(self.scene.original, Selection(where=self.where.value.strip() or None))
        except InputError as error:
            self.note.content = f"{error.advice} (still {self._counted()})"
            return
        self.values, self.note.content = {}, self._counted()
        self.scene.set_change(None)
        raw = self.scene.scene.surfels.to_numpy()
        for name, slider in self.sliders.items():
            slider.value = round(float(sigmoid(raw[name][self.mask, 0]).mean()), 2)

    def _counted(self) -> str:
        return f"{int(self.mask.sum()):,} of {len(self.mask):,} surfels"


def add_cameras(page: Page) -> None:
    """Add the frusta of the data set's cameras, displayed while a checkbox is ticked; a click goes to one."""
    if not page.views:
        return
    hint = "Blue: training, orange: test; click one to look from there."
    box, nodes = page.server.gui.add_checkbox("Cameras", False, hint=hint), list[Any]()
    lines = {"scale": 0.08 * page.scene.radius, "thickness": 1.5, "thickness_units": "screen"}

    def add(split: str, index: int, pose: Pose) -> None:
        name, more = f"/cameras/{split}/{index}", {"wxyz": pose.page_rotation, "position": pose.position}
        add_frustum = page.server.scene.add_camera_frustum
        nodes.append(add_frustum(name, pose.fov, pose.aspect, color=COLOURS[split], **lines, **more))
        nodes[-1].on_click(lambda event: page.go(event.client, pose))

    @box.on_update
    def _(_: Any) -> None:
        if box.value and not nodes:
            for split, data in page.data.items():
                for index, view in enumerate(data.views):
                    add(split, index, Pose.of_view(view))
        for node in nodes:
            node.visible = box.value


def add_saving(page: Page, scene: ReconstructionView) -> None:
    """Add the button that writes a view."""
    folder = page.views_folder
    hint = f"PNG as displayed, linear EXR, and camera, {SAMPLES} samples per pixel, into {folder}."
    button = page.server.gui.add_button("Save view", hint=hint)

    @button.on_click
    def _(event: Any) -> None:
        number = event.client.client_id

        def save() -> None:
            client = page.loop.clients.get(number)
            if client is not None and client.pose is not None:
                path = write_view(scene, client.pose, client.window, page.loop.look, folder)
                page.notify("Saved", str(path))

        page.loop.submit(("save", number), save, changes=False)


def write_view(
    scene: ReconstructionView, pose: Pose, size: tuple[int, int], look: DisplayOptions, folder: Path
) -> Path:
    """Write a view as PNG, EXR and camera with the next free number; returns the path of the PNG."""
    (width, height), camera = size, pose.camera(*size)
    planes = planes_of(scene.fine(camera, look), camera, look, scene.light)
    channels = planes if look.what == IMAGE else values_of_planes(look.what, planes)
    values = image_array(channels, height, width)
    if look.what == IMAGE:
        shown = straight_srgb(values * np.array([2.0**look.exposure] * 3 + [1], np.float32))
    else:
        shown = image_array(displayed_planes(planes, look, scene.depths(pose)), height, width)
        values = np.concatenate([values, image_array(planes[-1], height, width)[..., None]], axis=-1)
    stems = (f"view_{number:03d}" for number in itertools.count())
    stem = next(stem for stem in stems if not any(folder.glob(f"{stem}.*")))
    png = folder / f"{stem}.png"
    write_json(png.with_suffix(".json"), pose.transforms(width, height, stem))
    write_exr(png.with_suffix(".exr"), values, {2: "YA", 4: "RGBA"}[values.shape[-1]])
    write_png(png, shown)
    return png
