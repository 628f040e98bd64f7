"""What a reflectance model may pay for a smaller error, as data."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from mi_refgs.errors import InputError, abbreviated
from mi_refgs.shade.light.lobe_matrices import LEVEL_ROUGHNESS

MAX_RAYS = 4096
"""Rays of the lobe, or bounces, beyond which nothing changes but the time: the length of a kernel follows."""

DIRECTIONS = 24
"""Default number of directions of the hemisphere; R3DG has 64, which takes twice as long."""

MAX_DIRECTIONS = 64
"""Directions of the hemisphere at most: which of them are free is one bit each of a 64-bit word."""

MAX_LEVELS = len(LEVEL_ROUGHNESS)
"""Filtered levels of a light, at most: as many as there are matrices for."""

NEED_OCCLUSION = ("visibility_rays", "traced_bounces", "ambient_rays")
"""Options that do nothing where no ray is traced."""


@dataclass(frozen=True)
class Accuracy:
    """What to pay for a smaller error; everything is off by default, and costs nothing then.

    A model says which of them it honours. Raises InputError for a value out of range.
    """

    dominant: bool = False  # look light up along the lobe's dominant direction, not the mirror direction
    multiscatter: bool = False  # add the light that leaves after several bounces between facets
    visibility_rays: int = 1  # rays of the GGX lobe that the visibility is averaged over; 1: the mirror ray
    traced_bounces: int = 0  # times that what a blocked ray hits is shaded, in place of the indirect channel
    ambient_rays: int = 0  # of a mesh's vertex, for the share of diffuse light that arrives; 0: all of it
    directions: int = DIRECTIONS  # from which models that sum over the hemisphere take light
    light_levels: int = MAX_LEVELS  # levels of roughness that the light is filtered to; fewer cost less
    antialias: bool = False  # widen roughness by how much normals turn within a pixel

    def __post_init__(self) -> None:
        for name in ("dominant", "multiscatter", "antialias"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"accuracy: {name}: {abbreviated(getattr(self, name))} is not True or False")
        for name, what, least, most in (
            ("visibility_rays", "rays", 1, MAX_RAYS),
            ("traced_bounces", "bounces", 0, MAX_RAYS),
            ("ambient_rays", "rays", 0, MAX_RAYS),
            ("directions", "directions", 1, MAX_DIRECTIONS),
            ("light_levels", "levels", 2, MAX_LEVELS),
        ):
            number: Any = getattr(self, name)
            if type(number) is not int or not least <= number <= most:
                some = ", ".join(str(least + i) for i in range(3))
                raise InputError(
                    f"accuracy: {name}: {abbreviated(number)} is no number of {what}; use {some}, … {most}"
                )

    def chosen(self) -> list[str]:
        """Names of the options that differ from their defaults."""
        return [option.name for option in fields(self) if getattr(self, option.name) != option.default]


PLAIN = Accuracy()
"""Nothing paid for a smaller error."""
