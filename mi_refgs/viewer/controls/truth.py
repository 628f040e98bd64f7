"""The test views one by one, with the truth beside the picture."""

from __future__ import annotations

from typing import Any

from mi_refgs.data.dataset import Dataset
from mi_refgs.viewer.compare import Compared
from mi_refgs.viewer.page import Page
from mi_refgs.viewer.pose import Pose

ARRIVED, LEFT = 1e-3, 1e-2
"""Parts of the camera's distance, and radians, within which a page has reached a view, and beyond which a
visitor has moved away from it."""


def add(page: Page) -> None:
    """Add the controls; nothing without views."""
    data = page.views.test or page.views.train
    if data is None or not data.views:
        return
    Stepper(page, data)


class Stepper:
    """Which view each page compares with, if it does."""

    def __init__(self, page: Page, data: Dataset) -> None:
        self.page, self.data = page, data
        self.at: dict[int, tuple[Pose, bool]] = {}  # by page: the view's pose, and whether it was reached
        gui = page.server.gui
        what = "Test views" if data is page.views.test else "Training views"
        with gui.add_folder(what, expand_by_default=False):
            self.index = gui.add_slider("View", 0, max(len(data.views) - 1, 1), 1, 0)
            step = gui.add_button_group("Step", ("previous", "next", "leave"))
            self.note = gui.add_markdown("The truth is shown beside the picture until the camera moves.")

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
        compared = Compared(view, self.data, lambda psnr: self.tell(view.name, psnr))
        pose = Pose.of_view(view)
        self.at[client.client_id] = (pose, False)
        self.page.go(client, pose)
        self.page.loop.change(client.client_id, compared=compared)

    def leave(self, number: int) -> None:
        """Show a page the picture alone."""
        if self.at.pop(number, None) is not None:
            self.page.loop.change(number, compared=None)

    def moved(self, number: int, pose: Pose) -> None:
        """A page's camera has moved: by its visitor, if it had been at the view."""
        target, reached = self.at.get(number, (pose, False))
        if number not in self.at:
            return
        distance = float(abs(pose.position - self.page.drawable.centre).max())
        apart = target.apart(pose, distance)
        if reached and apart > LEFT:
            self.leave(number)
        elif apart < ARRIVED:
            self.at[number] = (target, True)

    def tell(self, name: str, psnr: float | None) -> None:
        """Say which view is shown, and how near the picture is to it."""
        score = "" if psnr is None else f", PSNR {psnr:.2f} dB"
        self.note.content = f"{name}{score}: truth left, ours right"
