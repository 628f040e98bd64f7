"""How long a frame takes, and on what."""

from __future__ import annotations

import os
import platform
import re
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.splat import Camera

WARM_UP_FRAMES = 2
"""Frames before the timing: the first compiles or loads the kernels, the second fills the memory pools."""
TIMED_FRAMES = 20
"""Frames whose median is reported; the views repeat if there are fewer."""


def machine() -> dict[str, Any]:
    """What the numbers were measured on."""
    try:
        found = re.search(
            r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(encoding="utf-8"), re.MULTILINE
        )
    except OSError:
        found = None
    return {
        "cpu": found.group(1) if found else platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": int(dr.thread_count()),
        "system": f"{platform.system()} {platform.machine()}",
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "mitsuba_variant": mi.variant(),
    }


def milliseconds(
    scenes: Sequence[Callable[[Camera], Frame]], cameras: list[Camera], data: Dataset
) -> list[float]:
    """Median time of a frame up to the displayed image, each waited for; of several scenes in turn."""
    seconds: list[list[float]] = [[] for _ in scenes]
    for i in range(WARM_UP_FRAMES + TIMED_FRAMES):
        for view, times in zip(scenes, seconds, strict=True):
            dr.sync_thread()
            begin = time.perf_counter()
            dr.eval(displayed(view(cameras[i % len(cameras)]), data.background, data.linear))
            dr.sync_thread()
            times.append(time.perf_counter() - begin)
    return [1000 * float(np.median(times[WARM_UP_FRAMES:])) for times in seconds]
