"""How long a frame takes."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import drjit as dr
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.splat import Camera

WARM_UP_FRAMES = 2
"""Frames before the timing: the first compiles or loads the kernels, the second fills the memory pools."""
TIMED_FRAMES = 20
"""Frames whose median is reported; the views repeat if there are fewer."""


def milliseconds(
    scenes: Sequence[Callable[[Camera], Frame]], cameras: list[Camera], data: Dataset
) -> list[float]:
    """Median time of a frame up to the displayed image, each waited for; of several scenes in turn."""
    seconds: list[list[float]] = [[] for _ in scenes]
    for i in range(WARM_UP_FRAMES + TIMED_FRAMES):
        for view, times in zip(scenes, seconds, strict=True):
            dr.sync_thread()
            begin = time.perf_counter()
            dr.eval(displayed(view(cameras[i % len(cameras)]), data.background, data.is_linear_radiance))
            dr.sync_thread()
            times.append(time.perf_counter() - begin)
    return [1000 * float(np.median(times[WARM_UP_FRAMES:])) for times in seconds]
