"""What is around and behind the object in the `refgs` integrator.

No Mitsuba class is defined here, so that this module need not be reloaded when the variant changes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mi_refgs.errors import InputError
from mi_refgs.plugins.properties import AROUND, read_background, read_surroundings
from mi_refgs.plugins.unusable import Values
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels


@dataclass(frozen=True)
class Around:
    """The surfels around an object, and the colour or the map behind everything."""

    surfels: Surfels | None
    colour: Any  # mi.Color3f; None without one
    map: EnvironmentLight | None

    @staticmethod
    def of(props: Any, surfels: Surfels) -> Around:
        """From the properties; raises InputError for what cannot be used with the object's surfels."""
        behind = read_background(props)
        is_map = isinstance(behind, EnvironmentLight)
        return Around(read_surroundings(props, surfels), *((None, behind) if is_map else (behind, None)))

    def check(self, surfels: Surfels, light: EnvironmentLight | None) -> None:
        """Raise InputError for shapes that do not fit."""
        if self.surfels is not None:
            Surroundings(Surfels(self.surfels.raw)).check(surfels)
        for name, found in self.values(surfels, light)[1].items():
            shape = tuple(found.raw.shape)
            if len(shape) != 3 or shape[2] != 3 or shape[1] != 2 * shape[0] or shape[0] % 4:
                raise InputError(f"refgs: {name}: shape {shape}, expected (h, 2h, 3) with h a multiple of 4")

    def values(self, surfels: Surfels, light: EnvironmentLight | None) -> Values:
        """All tables, and all lat-long maps, by name."""
        tables = {"surfels": surfels, "surroundings": self.surfels}
        maps = {"light": light, "background": self.map}
        return (
            {name: table for name, table in tables.items() if table is not None},
            {name: found for name, found in maps.items() if found is not None},
        )

    def parameters(self, surfels: Surfels, light: EnvironmentLight | None) -> dict[str, Any]:
        """The raw tensors of all of these by the names of the integrator's parameters."""
        around = {} if self.surfels is None else self.surfels.raw
        maps = self.values(surfels, light)[1]
        found = {AROUND + name: tensor for name, tensor in around.items()}
        return {**surfels.raw, **found, **{name: value.raw for name, value in maps.items()}}

    def count(self, surfels: Surfels) -> int:
        """Surfels of the object and of these."""
        return surfels.count + (0 if self.surfels is None else self.surfels.count)

    def splatted(self, surfels: Surfels) -> Surroundings | None:
        """What is splatted with the object's surfels, and the map behind; None without both."""
        if self.surfels is None and self.map is None:
            return None
        around = nothing_around(surfels) if self.surfels is None else self.surfels
        return Surroundings(Surfels(around.raw, screened=True), self.map)

    def behind(self, frame: Frame) -> Any:
        """Radiance (mi.Color3f) behind everything; None where that is transparent."""
        return frame.background if self.map is not None else self.colour
