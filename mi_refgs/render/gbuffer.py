"""The G-buffer: named values of the surfels, composited together and divided by alpha once."""

from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.linear import linear
from mi_refgs.kernels.rows import joined
from mi_refgs.render.stencil import ChosenPixels
from mi_refgs.splat.composite import Composited, inverse_alpha
from mi_refgs.types import Array, Arrays, Float

OBJECT = "object"  # slot of the object's opacity; where it is blended, slots are divided by it
SURROUNDINGS = "surroundings"  # slot of the radiance of the surroundings
Slots = Mapping[str, Any]  # values by name, such as mi.Color3f; each costs time in every pair


class GBuffer:
    """Blended slots of a view, in raster order or in that of `pixels`. A slot that nobody needs is absent."""

    def __init__(
        self,
        blended: Composited,
        kinds: Slots,
        attribution: int | None = None,
        pixels: ChosenPixels | None = None,
    ) -> None:
        """`blended` has the `features` of slots like `kinds`, and at `attribution` that of errors."""
        self.blended, self.alpha, self.pixels, maps = blended, blended.alpha, pixels, [*blended.features]
        self.attribution = None if attribution is None else maps.pop(attribution)
        self.slots = _grouped(kinds, maps)  # premultiplied by alpha
        self.opacity = self.slots.get(OBJECT, self.alpha)  # of the object
        self.inverse = inverse_alpha(self.opacity)
        self.depth = blended.expected_depth  # of the camera's z

    def of_object(self) -> "GBuffer":
        """The slots of the pixels that show the object, under AD; those of all, if none does."""
        raster = dr.compress(dr.detach(self.opacity) > 0)
        if not dr.width(raster):
            return self
        pixels, blended = ChosenPixels(raster, dr.width(self.alpha)), self.blended
        planes = linear((features(self.slots), blended.depth, self.alpha), pixels.of, pixels.placed)
        return GBuffer(Composited(*planes), self.slots, pixels=pixels)

    def placed(self, values: Arrays) -> Arrays:
        """Values of the pixels of `of_object` in raster order, under AD, 0 elsewhere."""
        return values if self.pixels is None else linear(values, self.pixels.placed, self.pixels.of)

    def divided(self, name: str) -> Any:
        """A slot divided by alpha or the object's opacity: the mean of what is seen, 0 where nothing is."""
        return self.slots[name] * self.inverse


def features(slots: Slots) -> list[Float]:
    return [part for value in slots.values() for part in _parts(value)]


def joined_slots(first: Slots, second: Slots, rows: tuple[int, int]) -> dict[str, Any]:
    """Slots of two surfel models of so many surfels, joined under AD; zero where one has none."""
    kinds = {**second, **first}
    columns: tuple[list[Any], list[Any]] = ([], [])
    for name, kind in kinds.items():
        for values, count, column in zip((first, second), rows, columns, strict=True):
            found = _parts(values[name]) if name in values else [mi.Float(0)] * len(_parts(kind))
            column += [x if dr.width(x) == count else x + dr.zeros(mi.Float, count) for x in found]
    return _grouped(kinds, joined(*columns))


def _parts(value: Array) -> list[Float]:
    return [*value] if dr.depth_v(value) > 1 else [value]


def _grouped(kinds: Slots, parts: Sequence[Float]) -> dict[str, Any]:
    rest = iter(parts)
    return {name: type(kind)(*islice(rest, len(_parts(kind)))) for name, kind in kinds.items()}
