"""What the footprints of surfels and of 3D Gaussians share: each primitive is a module with four functions.

    culled(raw, camera, rules)           which rows (N,) cover no pixel
    footprint(raw, camera, rules, x, y)  Sample (N, P) at pixel centres x, y (P,)
    sort_key(raw, camera, pixels, corner)
                                         depth (N, P) by which rows are ordered in the tiles of pixels (raster
                                         indices); `corner` is the first pixel's place in its tile
    normal(raw)                          which of the three axes (N,) is the normal

Letters: N primitives, P pixels. Raw channels are real or, for derivatives by a complex step, complex. The
columns of its `scale` say which primitive a table is of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.camera import PinholeCamera

Array = np.ndarray
GEOMETRY = ("position", "rotation", "scale", "opacity")


@dataclass(frozen=True)
class Rules:
    """The named constants of footprints and compositing; others than the product's measure their bias."""

    alpha_min: float = c.ALPHA_MIN
    alpha_max: float = c.ALPHA_MAX
    transmittance_min: float = c.TRANSMITTANCE_MIN
    low_pass: float | None = c.LOW_PASS_INV_VARIANCE  # None: no screen-space filter
    edge_on: float = c.EDGE_ON_COSINE


@dataclass(frozen=True)
class Sample:
    """Footprints at pixels, (N, P) each."""

    alpha: Array  # after the clamp
    z: Array  # depth of the sample
    unclamped: Array  # real part of α before the clamp
    jump: Array  # relative distance of ρ to where depth jumps; infinite where it does not


def tile_centres(camera: PinholeCamera, pixels: Array, corner: tuple[int, int]) -> tuple[Array, Array]:
    """Centres x, y (P,) of the tiles of pixels; `corner` is the first pixel's place in its tile."""
    width, height = c.tile_size(abs(camera.fx))
    x = (pixels % camera.width + corner[0]) // width * width + width / 2 - corner[0]
    y = (pixels // camera.width + corner[1]) // height * height + height / 2 - corner[1]
    return x, y
