"""Some pixels of an image, and neighbours in a plane, with an adjoint that only gathers (deterministic)."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.linear import linear
from mi_refgs.kernels.trees import mapped
from mi_refgs.types import Array, Arrays, Bool, Float, UInt32

# A step (dx, dy) in pixels, each -1, 0 or 1.
Step = tuple[int, int]
STEPS: list[Step] = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]  # to the neighbours
NOWHERE = 0xFFFFFFFF  # place of a pixel that was not chosen


@dataclass(frozen=True)
class ChosenPixels:
    """P of the pixels of an image, each once."""

    raster: UInt32  # (P,): index in the image
    count: int  # pixels of the image

    @cached_property
    def place(self) -> UInt32:
        """Which of the P each pixel of the image is (H·W,), NOWHERE for the others."""
        place = dr.full(mi.UInt32, NOWHERE, self.count)
        index = dr.arange(mi.UInt32, dr.width(self.raster))
        dr.scatter(place, index, self.raster, mode=dr.ReduceMode.NoConflicts)
        dr.eval(place)
        return place

    def of(self, planes: Arrays) -> Arrays:
        """Values (P,) of planes (H·W,)."""
        dr.eval(planes)
        return mapped(lambda plane: dr.gather(type(plane), plane, self.raster), planes)

    def placed(self, values: Arrays) -> Arrays:
        """Planes (H·W,) of values (P,), evaluated, 0 at other pixels."""

        def placed(value: Array) -> Array:
            plane = dr.zeros(type(value), self.count)
            dr.scatter(plane, value, self.raster, mode=dr.ReduceMode.NoConflicts)
            return plane

        planes = mapped(placed, values)
        dr.eval(planes)
        return planes

    def at(self, values: Float, raster: UInt32, active: Bool = True) -> Float:
        """Values (P,) at pixels by their index in the image, 0 where there is nothing."""
        place = dr.gather(mi.UInt32, self.place, raster, active)
        return dr.gather(mi.Float, values, place, active & (place != NOWHERE))


def neighbours(
    plane: Float, width: int, height: int, steps: Sequence[Step], pixels: ChosenPixels | None = None
) -> list[Float]:
    """The plane (mi.Float, raster order) by each step: out_k(x, y) = plane(x + dx_k, y + dy_k), dx, dy in
    {-1, 0, 1}, borders repeated. A plane (P,) of some `pixels` is 0 at all others."""

    def beside(pixel: UInt32) -> list[UInt32]:
        x, y = pixel % width, pixel // width
        return [_moved(y, dy, height) * width + _moved(x, dx, width) for dx, dy in steps]

    own = dr.arange(mi.UInt32, width * height) if pixels is None else pixels.raster

    def at(plane: Float, place: UInt32, mask: Bool = True) -> Float:
        return dr.gather(mi.Float, plane, place, mask) if pixels is None else pixels.at(plane, place, mask)

    def shifted(plane: Float) -> list[Float]:
        dr.eval(plane)
        return [at(plane, place) for place in beside(own)]

    def gathered(shifts: list[Float]) -> Float:
        """Pixel s was read by the pixels p = s - step and, where the border repeats, by s itself."""
        x, y = own % width, own // width
        total = mi.Float(0)
        dr.eval(shifts)
        for (dx, dy), shift in zip(steps, shifts, strict=True):
            for reader_y, read_y in _readers(y, dy, height):
                for reader_x, read_x in _readers(x, dx, width):
                    total += at(shift, reader_y * width + reader_x, read_x & read_y)
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
