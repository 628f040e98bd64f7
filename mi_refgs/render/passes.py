"""Images rendered in passes, bands of rows one after the other, so that memory does not grow with samples.

A band keeps its place in the tiles of the whole image: its tiles have the same lists, and its pixels the same
values. Bands are equally high, and their places are opaque, so that one set of kernels serves all of them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import PACKET_EDGE
from mi_refgs.kernels.memory import PASS_SAMPLES, require_image
from mi_refgs.splat.camera import Camera

Result = TypeVar("Result")


@dataclass(frozen=True)
class Band:
    """Rows of an image that are rendered together."""

    camera: Camera  # of the rows, and of `margin` neighbours on all sides that lie on the film
    first: tuple[int, int]  # column and row of the band's first pixel in what `camera` sees
    size: tuple[int, int]  # columns and rows of the band

    @property
    def rows(self) -> int:
        """Rows of the band."""
        return self.size[1]

    def kept(self, value: Any) -> Any:
        """Values of the band's own pixels, of an array of values of all pixels of `camera`, or of one."""
        if dr.width(value) == 1 or self.size == (self.camera.width, self.camera.height):
            return value
        index, columns = dr.arange(mi.UInt32, self.size[0] * self.size[1]), self.size[0]
        first = dr.opaque(mi.UInt32, self.first[1] * self.camera.width + self.first[0])
        return dr.gather(type(value), value, index // columns * self.camera.width + index % columns + first)


def bands(camera: Camera, factor: int = 1, margin: int = 0, most: int | None = None) -> list[Band]:
    """The bands of a camera's image for passes of at most so many samples, factor² per pixel.

    `margin`: pixels of neighbours that the values of a pixel depend on. Without one, the last band may reach
    below the image, as high as the others. `most` is PASS_SAMPLES by default; a band has PACKET_EDGE rows of
    samples at least.
    """
    most = PASS_SAMPLES if most is None else most
    width, height = camera.width, camera.height
    film, offset = camera.film or (width, height), camera.offset if camera.film else (0, 0)
    left, right = min(margin, offset[0]), min(margin, film[0] - offset[0] - width)
    high = height
    if width * height * factor**2 > most:
        step = PACKET_EDGE // math.gcd(PACKET_EDGE, factor)  # tiles of all bands begin at their first row
        highest = max(most // (width * factor**2) // step * step, step)
        count = -(-height // highest)
        high = -(-height // (count * step)) * step
    found = []
    for top in range(0, height, high):
        first, last = top - margin, top + high + margin
        if margin:
            first, last = max(first, -offset[1]), min(last, film[1] - offset[1])
        whole = (left, first, right, last) == (0, 0, 0, height)
        part = camera if whole else camera.window(-left, first, left + width + right, last - first)
        found.append(Band(part, (left, top - first), (width, min(high, height - top))))
    return found


MAPS = 24
"""Channels of a frame with all its maps, about."""


def in_passes(
    draw: Callable[[Camera], Result], camera: Camera, factor: int = 1, margin: int = 0, surfels: int = 0
) -> Result:
    """What `draw` gives for a camera, drawn in the `bands` of its image; without derivatives.

    `draw` returns arrays of one value per pixel or one in all, in lists, dictionaries and dataclasses. It
    takes factor² samples per pixel. Raises InputError where an image of `surfels` does not fit into memory.
    """
    require_image((camera.width, camera.height), factor**2, surfels, MAPS)
    found = bands(camera, factor, margin)
    if found[0].camera is camera:
        return draw(camera)
    parts = []
    for band in found:
        arrays: list[Any] = []

        def kept(value: Any, band: Band = band, arrays: list[Any] = arrays) -> Any:
            arrays.append(band.kept(value))
            return arrays[-1]

        parts.append(_mapped(kept, draw(band.camera)))
        dr.eval(arrays)  # or memory would hold the samples of all bands

    def stacked(*values: Any) -> Any:
        if all(dr.width(value) == 1 for value in values):
            return values[0]
        wide = [x + dr.zeros(type(x), b.rows * camera.width) for x, b in zip(values, found, strict=True)]
        return dr.concat(wide)

    return _mapped(stacked, *parts)


def _mapped(function: Callable[..., Any], *trees: Any) -> Any:
    """Trees of arrays (None and flags stay) as one of what a function makes of each of their leaves."""
    first = trees[0]
    if first is None or isinstance(first, bool):
        return first
    if isinstance(first, dict):
        return {name: _mapped(function, *(tree[name] for tree in trees)) for name in first}
    if isinstance(first, list):
        return [_mapped(function, *parts) for parts in zip(*trees, strict=True)]
    if dataclasses.is_dataclass(first) and not isinstance(first, type):
        names = [field.name for field in dataclasses.fields(first)]
        return replace(
            first, **{name: _mapped(function, *(getattr(tree, name) for tree in trees)) for name in names}
        )
    if dr.depth_v(first) > 1:
        return type(first)(*(_mapped(function, *parts) for parts in zip(*trees, strict=True)))
    return function(*trees)
