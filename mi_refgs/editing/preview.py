"""Pictures before and after an edit, beside each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_refgs.evaluation import images
from mi_refgs.render.display import displayed
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera

VIEWS = 4
"""Rows, spread evenly over the cameras."""
WHITE = np.ones(3, np.float32)


def before_and_after(
    before: TrainedScene,
    after: TrainedScene,
    cameras: Sequence[Camera],
    background: np.ndarray = WHITE,
    linear: bool = False,
) -> np.ndarray:
    """Some cameras' pictures of both, a row each, (H, W, 3) display-encoded as `displayed` has them."""
    some = np.unique(np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int))
    renderers = {"before": before.renderer(aovs=False), "after": after.renderer(aovs=False)}
    rows = []
    for camera in (cameras[i] for i in some):
        shots = {title: displayed(view(camera), background, linear) for title, view in renderers.items()}
        size = camera.height, camera.width
        rows.append({title: np.clip(images.image_array(x, *size), 0, 1) for title, x in shots.items()})
    return images.contact_sheet(rows)
