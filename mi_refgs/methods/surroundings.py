"""What a method file says of the surroundings of an object."""

from __future__ import annotations

from dataclasses import dataclass

from mi_refgs.shade.light.envmap import MIN_HEIGHT, is_height
from mi_refgs.surfels.attributes import MAX_SH_DEGREE
from mi_refgs.surfels.primitives import PRIMITIVES

BACKGROUND, AROUND = "background", "surroundings/"
"""Name of what lies behind everything among the parameters of a fit, and what the names of the surroundings'
channels begin with."""


@dataclass(frozen=True)
class SurroundingsOptions:
    """What lies outside of the region of interest, where pictures have no alpha: surfels of the object's
    primitive with radiance_sh alone, and a lat-long background behind everything.
    """

    count: int = 20_000  # initial surfels
    max_count: int = 40_000  # densification stops here
    degree: int = 2  # of radiance_sh
    scattered: float = 0.5  # share of the initial surfels all over; the others at sparse points
    opacity: float = 0.1  # initial, of both tables: a cloud of 0.3 closes to a shell before the object
    size: float = 0.1  # largest initial size, in distances from the region's centre
    prune_extent: float = 0.5  # distances from the region's centre; larger surfels go
    reach: float = 2.0  # of positions' rates, in scene extents
    height: int = 32  # texels of the background; width is twice that
    rate: float = 0.01  # Adam's, of the background's texels

    def names(self, primitive: str) -> tuple[str, ...]:
        """All channels of a table of a primitive."""
        return (*PRIMITIVES.find(primitive, "primitive").widths, "radiance_sh")

    def fault(self) -> str:
        """Which value cannot be used, and what to give; empty if all can."""
        for key, value, fits, wanted in (
            ("count", self.count, self.count >= 1, "1 or more"),
            ("degree", self.degree, 0 <= self.degree <= MAX_SH_DEGREE, f"0 to {MAX_SH_DEGREE}"),
            ("scattered", self.scattered, 0 <= self.scattered <= 1, "a share from 0 to 1"),
            ("opacity", self.opacity, 0 < self.opacity < 1, "a number between 0 and 1"),
            ("size", self.size, self.size > 0, "more than 0"),
            ("prune_extent", self.prune_extent, self.prune_extent > 0, "more than 0"),
            ("reach", self.reach, self.reach > 0, "more than 0"),
            ("height", self.height, is_height(self.height), f"a multiple of 4 from {MIN_HEIGHT}"),
        ):
            if not fits:
                return f"{key}: {value} is out of range; give {wanted}"
        return ""
