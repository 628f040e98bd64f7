"""Rendering by bands of rows of one image's tiles, equally high for one set of kernels: bounded memory."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import PATCH_EDGE
from mi_refgs.kernels.memory import PASS_SAMPLES, require_image
from mi_refgs.kernels.trees import mapped
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import samples_per_axis, supersampled
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Array


@dataclass(frozen=True)
class Band:
    """Rows of an image that are rendered together."""

    camera: Camera  # of the rows, and of `margin` neighbours on all sides that lie on the film
    first: tuple[int, int]  # column and row of the band's first pixel in what `camera` sees
    size: tuple[int, int]  # columns and rows of the band

    def kept(self, value: Array) -> Array:
        """The band's own pixels of an array of values per pixel of `camera`; one of width 1 stays."""
        if dr.width(value) == 1 or self.size == (self.camera.width, self.camera.height):
            return value
        index, columns = dr.arange(mi.UInt32, self.size[0] * self.size[1]), self.size[0]
        first = dr.opaque(mi.UInt32, self.first[1] * self.camera.width + self.first[0])
        return dr.gather(type(value), value, index // columns * self.camera.width + index % columns + first)


def bands(camera: Camera, factor: int = 1, margin: int = 0, most: int | None = None) -> list[Band]:
    """Divide an image into bands of at most `most` samples (default: PASS_SAMPLES), factor² per pixel, and at
    least PATCH_EDGE rows; without a `margin` of pixels, the last may reach below the image."""
    most = PASS_SAMPLES if most is None else most
    width, height = camera.width, camera.height
    film, offset = camera.film or (width, height), camera.offset if camera.film else (0, 0)
    left, right = (min(margin, max(beside, 0)) for beside in (offset[0], film[0] - offset[0] - width))
    high = height
    if width * height * factor**2 > most:
        step = PATCH_EDGE // math.gcd(PATCH_EDGE, factor)  # tiles of all bands begin at their first row
        highest = max(most // (width * factor**2) // step * step, step)
        count = -(-height // highest)
        high = -(-height // (count * step)) * step
    found = []
    for top in range(0, height, high):
        below = top + high
        first = min(top, max(top - margin, -offset[1]))  # beside its own rows, only those of the film
        last = max(min(below, height), min(below + margin, film[1] - offset[1])) if margin else below
        whole = (left, first, right, last) == (0, 0, 0, height)
        part = camera if whole else camera.window(-left, first, left + width + right, last - first)
        found.append(Band(part, (left, top - first), (width, min(high, height - top))))
    return found


def in_passes(
    draw: Callable[[Camera], Frame], camera: Camera, samples: int, margin: int, count: int, maps: bool = True
) -> Frame:
    """A frame of `count` surfels, detached, as `supersampled` renders it by `draw`, but in bands whose arrays
    are joined. Raises InputError for an image above the memory."""
    factor = samples_per_axis(samples)
    require_image((camera.width, camera.height), factor**2, count, channels=24)  # with all maps, about
    found = bands(camera, factor, margin)
    if found[0].camera is camera:
        return supersampled(draw, camera, samples, maps)
    parts = []
    for band in found:
        arrays: list[Any] = []

        def kept(value: Array, band: Band = band, arrays: list[Any] = arrays) -> Array:
            arrays.append(band.kept(value))
            return arrays[-1]

        parts.append(mapped(kept, supersampled(draw, band.camera, samples, maps)))
        dr.eval(arrays)  # or the samples of all bands would stay in memory

    def stacked(*values: Array) -> Array:
        if all(dr.width(value) == 1 for value in values):
            return values[0]
        sizes = [band.size[0] * band.size[1] for band in found]
        return dr.concat([x + dr.zeros(type(x), size) for x, size in zip(values, sizes, strict=True)])

    return mapped(stacked, *parts)
