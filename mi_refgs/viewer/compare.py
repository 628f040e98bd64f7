"""A view of the data set beside what is drawn from its camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.view import View
from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import image_array
from mi_refgs.io.images import to_8_bits
from mi_refgs.render.display import displayed
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.tonemap import IMAGE, DisplayOptions, shown_planes, to_bytes
from mi_refgs.viewer.viewer_scene import SampleRequest, ViewerScene

AROUND = 0.12
"""Display-encoded brightness beside the two pictures."""
GAP = 8
"""Pixels between the two."""
LONGEST = 8.0
"""Aspect ratio of the canvas, at most: of a window of one row of pixels it would not fit into memory."""


@dataclass(eq=False)
class Compared:
    """A view whose truth stands to the left of the picture."""

    view: View
    data: Dataset
    tell: Callable[[float | None], None]  # told the PSNR of each picture that is drawn, None of a variable

    def picture(self, drawable: ViewerScene, look: DisplayOptions, window: tuple[int, int]) -> np.ndarray:
        """Both, as large as they fit into a window: 8-bit RGB of the window's shape."""
        view = self.view.load()
        frame_of = getattr(drawable, "frame", None)
        truth = np.clip(view.displayed, 0, 1)
        if look.what == IMAGE and frame_of is not None:
            shown = displayed(frame_of(view.camera()), self.data.background, self.data.is_linear_radiance)
            ours = image_array(shown, view.height, view.width)
            self.tell(metrics.psnr(ours, truth))
            drawn = to_8_bits(ours)
        else:
            sample = SampleRequest(
                Pose.of_view(view), view.width, view.height, look, settled=True, exact=view.camera()
            )
            self.tell(None)
            drawn = to_bytes(shown_planes(drawable.draw(sample).planes, look), view.width, view.height)
        return side_by_side([to_8_bits(truth), drawn], window)


def side_by_side(pictures: list[np.ndarray], window: tuple[int, int]) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of one size in a row, on a canvas of the window's shape."""
    height, width = pictures[0].shape[:2]
    row = len(pictures) * width + (len(pictures) - 1) * GAP
    aspect = min(max(window[0] / window[1], 1 / LONGEST), LONGEST)
    canvas_width = max(row, round(height * aspect))
    canvas_height = max(height, round(canvas_width / aspect))
    canvas = np.full((canvas_height, canvas_width, 3), round(255 * AROUND), np.uint8)
    left, top = (canvas_width - row) // 2, (canvas_height - height) // 2
    for index, picture in enumerate(pictures):
        start = left + index * (width + GAP)
        canvas[top : top + height, start : start + width] = picture
    return canvas
