"""Times of images of a run at three sizes, without derivatives.

python -m benchmarks.frames RUN
"""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common.report import plain_parser
from mi_refgs import load

SIZES = (200, 400, 800)  # pixels along the longer side
ROUNDS, WARM_UP = 9, 2  # timed images of each size, and those before, which compile kernels


def measure(run: Path, sizes: Sequence[int | tuple[int, int]] = SIZES) -> list[dict[str, float]]:
    """Width, height and median milliseconds for each size: the longer side, or both."""
    found = load(run, write=False)
    draw, rows = found.trained.renderer(aovs=False), []
    for size in sizes:
        camera, times = found.camera(0).resized(size), []
        for _ in range(WARM_UP + ROUNDS):
            begin = time.perf_counter()
            frame = draw(camera)
            dr.eval(frame.radiance, frame.alpha, frame.background)
            dr.sync_thread()
            times.append(1e3 * (time.perf_counter() - begin))
        ms = float(np.median(times[WARM_UP:]))
        rows.append({"width": camera.width, "height": camera.height, "frame_ms": ms})
    return rows


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    parser = plain_parser("frames", __doc__)
    parser.add_argument("run", type=Path)
    frames = measure(parser.parse_args().run)
    print(json.dumps({"frames": frames, "threads": int(dr.thread_count())}))
