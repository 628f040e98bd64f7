"""Stepping through the test views, with the ground truth beside the rendered image."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import image_array
from mi_refgs.io.images import to_8_bits
from mi_refgs.render.display import displayed
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.tonemap import BACKGROUND, IMAGE, DisplayOptions, displayed_planes, to_bytes
from mi_refgs.viewer.viewer_scene import SampleRequest, ViewerScene

ARRIVED, LEFT = 1e-3, 1e-2
"""`Pose.difference` below which a camera has reached a view, and above which the user has moved it away."""
BORDER = 0.12
"""Display-encoded brightness beside the two images."""
GAP = 8
"""Pixels between the two."""
LONGEST = 8.0
"""Largest aspect ratio of the canvas: that of a window one pixel high would not fit into memory."""


def add_comparison(page: Page) -> None:
    """Add the controls; none without views."""
    data = page.data.get("test") or page.data.get("train")
    if data is not None and data.views:
        ComparisonPanel(page, data)


class ComparisonPanel:
    """The controls, and the view that each page compares with."""

    def __init__(self, page: Page, data: Dataset) -> None:
        self.page, self.data = page, data
        self.at: dict[int, tuple[Pose, bool]] = {}  # by client: the view's pose, and whether it was reached
        gui = page.server.gui
        title = "Test views" if data is page.data.get("test") else "Training views"
        with gui.add_folder(title, expand_by_default=False):
            self.index = gui.add_slider("View", 0, max(len(data.views) - 1, 1), 1, 0)
            step = gui.add_button_group("Step", ("previous", "next", "leave"))
            self.note = gui.add_markdown("Displays the ground truth beside the image until the camera moves.")

        @step.on_click
        def _(event: Any) -> None:
            if step.value == "leave":
                self.leave(event.client.client_id)
                return
            by = 1 if step.value == "next" else -1
            if self.at:
                self.index.value = (self.index.value + by) % len(data.views)
            self.show(event.client)

        @self.index.on_update
        def _(event: Any) -> None:
            if event.client is not None:
                self.show(event.client)

        page.moved = self.moved

    def show(self, client: Any) -> None:
        """Let a page compare with the chosen view, and move its camera there."""
        view = self.data.views[self.index.value % len(self.data.views)]

        def comparison(scene: ViewerScene, look: DisplayOptions, window: tuple[int, int]) -> np.ndarray:
            images, psnr = compared(scene, look, view, self.data)
            score = "" if psnr is None else f", PSNR {psnr:.2f} dB"
            self.note.content = f"{view.name}{score}: ground truth left, rendered right"
            return side_by_side(images, window)

        pose = Pose.of_view(view)
        self.at[client.client_id] = (pose, False)
        self.page.go(client, pose)
        self.page.loop.change(client.client_id, comparison=comparison)

    def leave(self, number: int) -> None:
        """Let a page display its own image again."""
        if self.at.pop(number, None) is not None:
            self.page.loop.change(number, comparison=None)

    def moved(self, number: int, pose: Pose) -> None:
        """End the comparison once a camera that had reached the view leaves it."""
        if number not in self.at:
            return
        view, reached = self.at[number]
        difference = view.difference(pose, float(abs(pose.position - self.page.scene.centre).max()))
        if reached and difference > LEFT:
            self.leave(number)
        elif difference < ARRIVED:
            self.at[number] = (view, True)


def compared(
    scene: ViewerScene, look: DisplayOptions, view: View, data: Dataset
) -> tuple[list[np.ndarray], float | None]:
    """Return ground truth and rendered image (H, W, 3) uint8 of a view, and the PSNR; None for an AOV."""
    truth, size = np.clip(view.load().displayed, 0, 1), (view.width, view.height)
    sample = SampleRequest(Pose.of_view(view), *size, look, settled=True, exact=view.camera())
    if look.what == IMAGE and isinstance(scene, ReconstructionView):
        sample = replace(sample, look=DisplayOptions(backdrop=BACKGROUND))
        shown = displayed(scene.frame(sample), data.background, data.is_linear_radiance)
        ours = image_array(shown, view.height, view.width)
        return [to_8_bits(truth), to_8_bits(ours)], metrics.psnr(ours, truth)
    drawn = to_bytes(displayed_planes(scene.draw(sample).planes, look), *size)
    return [to_8_bits(truth), drawn], None


def side_by_side(images: list[np.ndarray], window: tuple[int, int]) -> np.ndarray:
    """Return images (H, W, 3) uint8 of one size in a row, on a canvas of the window's shape."""
    height, width = images[0].shape[:2]
    row = len(images) * width + (len(images) - 1) * GAP
    aspect = min(max(window[0] / window[1], 1 / LONGEST), LONGEST)
    canvas_width = max(row, round(height * aspect))
    canvas_height = max(height, round(canvas_width / aspect))
    canvas = np.full((canvas_height, canvas_width, 3), round(255 * BORDER), np.uint8)
    left, top = (canvas_width - row) // 2, (canvas_height - height) // 2
    for index, image in enumerate(images):
        start = left + index * (width + GAP)
        canvas[top : top + height, start : start + width] = image
    return canvas
