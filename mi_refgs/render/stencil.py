"""Neighbouring pixels of an image plane, with an adjoint that only gathers (deterministic)."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.linear import linear
from mi_refgs.splat.lanes import CompactedPixels
from mi_refgs.types import Bool, Float, UInt32

# A step (dx, dy) in pixels, each -1, 0 or 1.
Step = tuple[int, int]


def neighbours(
    plane: Float, width: int, height: int, steps: Sequence[Step], pixels: CompactedPixels | None = None
) -> list[Float]:
    """The plane (mi.Float, raster order) by each step: out_k(x, y) = plane(x + dx_k, y + dy_k), dx, dy in
    {-1, 0, 1}, borders repeated. A plane of compacted `pixels`, detached, is 0 at all others."""

    def beside(pixel: UInt32) -> list[UInt32]:
        x, y = pixel % width, pixel // width
        return [_moved(y, dy, height) * width + _moved(x, dx, width) for dx, dy in steps]

    if pixels is not None:
        dr.eval(plane)
        inside = dr.minimum(pixels.raster, width * height - 1)  # patches reach beyond the image
        return [pixels.at(plane, i) for i in beside(inside)]

    def shifted(plane: Float) -> list[Float]:
        dr.eval(plane)
        return [dr.gather(mi.Float, plane, i) for i in beside(dr.arange(mi.UInt32, width * height))]

    def gathered(shifts: list[Float]) -> Float:
        """Pixel s was read by the pixels p = s - step and, where the border repeats, by s itself."""
        index = dr.arange(mi.UInt32, width * height)
        x, y = index % width, index // width
        total = mi.Float(0)
        dr.eval(shifts)
        for (dx, dy), shift in zip(steps, shifts, strict=True):
            for reader_y, read_y in _readers(y, dy, height):
                for reader_x, read_x in _readers(x, dx, width):
                    total += dr.gather(mi.Float, shift, reader_y * width + reader_x, read_x & read_y)
        return total

    return list(linear(plane, shifted, gathered))


def _moved(place: UInt32, step: int, size: int) -> UInt32:
    """Place + step along one axis, clamped to the image."""
    if step > 0:
        return dr.minimum(place + 1, size - 1)
    return dr.select(place > 0, place - 1, 0) if step < 0 else place


def _readers(place: UInt32, step: int, size: int) -> list[tuple[UInt32, Bool]]:
    """Places along one axis that read `place` when moved by step, each with the mask where it does."""
    if step == 0:
        return [(place, mi.Bool(True))]
    border = size - 1 if step > 0 else 0
    first = 0 if step > 0 else size - 1
    return [(place - step if step > 0 else place + 1, place != first), (place, place == border)]
