"""Times of images of a run at three sizes, without derivatives: python -m benchmarks.frames --run RUN"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.common.report import benchmark
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


@dataclass(frozen=True)
class Settings:
    """The runs, each of whose images are timed."""

    runs: tuple[str, ...] = ()


def measure_runs(settings: Settings, quiet: bool) -> dict[str, Any]:
    """Times of the images of all runs."""
    return {"frames": [row for run in settings.runs for row in measure(Path(run))]}


if __name__ == "__main__":
    sys.exit(benchmark("frames", __doc__, measure_runs, Settings(), several=("--run", "runs")))
