"""Neighbouring pixels of an image plane, with an adjoint that only gathers (deterministic)."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from mi_refgs.splat.lanes import CompactedPixels
from mi_refgs.types import Bool, Float, UInt32

# A step (dx, dy) in pixels, each -1, 0 or 1.
Step = tuple[int, int]


def neighbours(
    plane: Float, width: int, height: int, steps: Sequence[Step], pixels: CompactedPixels | None = None
) -> list[Float]:
    """The plane (mi.Float, raster order) by each step: out_k(x, y) = plane(x + dx_k, y + dy_k), dx, dy in
    {-1, 0, 1}, borders repeated. A plane of compacted `pixels`, detached, is 0 at all others."""
    if pixels is None:
        return list(dr.custom(_Neighbours, plane, width, height, tuple(steps)))
    dr.eval(plane)
    inside = dr.minimum(pixels.raster, width * height - 1)  # patches reach beyond the image
    x, y = inside % width, inside // width
    index = [_moved(y, dy, height) * width + _moved(x, dx, width) for dx, dy in steps]
    return [pixels.at(plane, i) for i in index]


class _Neighbours(dr.CustomOp):
    def eval(self, plane: Float, width: int, height: int, steps: tuple[Step, ...]) -> list[Float]:
        self.width, self.height, self.steps = width, height, steps
        return self._shift(plane)

    def _shift(self, plane: Float) -> list[Float]:
        dr.eval(plane)
        x, y = _pixel(self.width, self.height)
        return [
            dr.gather(mi.Float, plane, _moved(y, dy, self.height) * self.width + _moved(x, dx, self.width))
            for dx, dy in self.steps
        ]

    def forward(self) -> None:
        self.set_grad_out(self._shift(self.grad_in("plane")))

    def backward(self) -> None:
        """Pixel s was read by the pixels p = s - step and, where the border repeats, by s itself."""
        x, y = _pixel(self.width, self.height)
        δ_plane = mi.Float(0)
        δ_out = self.grad_out()
        dr.eval(δ_out)
        for (dx, dy), δ in zip(self.steps, δ_out, strict=True):
            for reader_y, read_y in _readers(y, dy, self.height):
                for reader_x, read_x in _readers(x, dx, self.width):
                    δ_plane += dr.gather(mi.Float, δ, reader_y * self.width + reader_x, read_x & read_y)
        self.set_grad_in("plane", δ_plane)

    def name(self) -> str:
        return "neighbours"


def _pixel(width: int, height: int) -> tuple[UInt32, UInt32]:
    index = dr.arange(mi.UInt32, width * height)
    return index % width, index // width


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
