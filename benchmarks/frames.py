"""Times of images of a run at three sizes, without derivatives.

python -m benchmarks.frames RUN"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from benchmarks.common.report import plain_parser
from benchmarks.common.timing import milliseconds
from mi_refgs import Camera, load

SIZES = (200, 400, 800)  # pixels along the longer side
ROUNDS = 9  # timed images of each size


def measure(run: Path, sizes: Sequence[int | tuple[int, int]] = SIZES) -> list[dict[str, float]]:
    """Width, height and median milliseconds for each size: the longer side, or both."""
    found = load(run, write=False)
    draw = found.trained.renderer(aovs=False)

    def image(camera: Camera) -> Any:
        frame = draw(camera)
        return frame.radiance, frame.alpha, frame.background

    cameras = [found.camera(0).resized(size) for size in sizes]
    calls = {(camera.width, camera.height): partial(image, camera) for camera in cameras}
    times = milliseconds(calls, math.inf, ROUNDS)
    return [{"width": width, "height": height, "frame_ms": ms} for (width, height), ms in times.items()]


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    parser = plain_parser("frames", __doc__)
    parser.add_argument("run", type=Path)
    frames = measure(parser.parse_args().run)
    print(json.dumps({"frames": frames, "threads": int(dr.thread_count())}))
