"""What a picture costs without derivatives, and what each arbitrary output variable (AOV) adds to it."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass

import drjit as dr
import numpy as np

from mi_refgs.render.pipeline import Frame
from mi_refgs.splat import Camera

SIZES = (200, 400, 800)
"""Pixels along the longer side of a picture."""
ROUNDS = 9
"""Pictures of each kind that are timed, one after the other in turns: what else the machine does then slows
all kinds alike."""
WARM_UP = 2
"""Rounds before the first that counts: they compile kernels."""

Draw = Callable[[Camera, Collection[str]], Frame]
"""Renders a view with the AOVs of these names."""


@dataclass(frozen=True)
class FrameProfile:
    """Pictures of one size."""

    width: int
    height: int
    frame_ms: float  # radiance and alpha alone, median
    aovs_ms: dict[str, float]  # what each AOV alone adds, median of the differences in a round


def aovs_of(frame: Frame) -> list[str]:
    """The AOVs that a frame with all of them has, apart from alpha, which every frame has."""
    # A term that the model does not have is a single zero.
    terms = {} if frame.terms is None else frame.terms.known()
    return [*frame.maps, "normal", "depth", *(name for name, term in terms.items() if dr.width(term) > 1)]


def profile_frame(draw: Draw, names: Collection[str], camera: Camera, rounds: int = ROUNDS) -> FrameProfile:
    """Time the picture of a camera alone and with each of the named AOVs, in turns."""
    plain: list[float] = []
    more: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(WARM_UP + rounds):
        plain.append(_seconds(draw, camera, ()))
        for name, found in more.items():
            found.append(_seconds(draw, camera, (name,)) - plain[-1])
    return FrameProfile(
        camera.width, camera.height, _median(plain), {name: _median(found) for name, found in more.items()}
    )


def _median(seconds: list[float]) -> float:
    return 1e3 * float(np.median(seconds[WARM_UP:]))


def _seconds(draw: Draw, camera: Camera, names: Collection[str]) -> float:
    begin = time.perf_counter()
    frame = draw(camera, names)
    dr.eval(frame.radiance, frame.alpha, frame.depth, frame.normal, frame.terms, frame.maps, frame.background)
    dr.sync_thread()
    return time.perf_counter() - begin
