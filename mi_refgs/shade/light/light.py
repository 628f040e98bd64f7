"""Lights: the protocol of three lookups that reflectance models use."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi

from mi_refgs.kernels.motion import part_of, turned_by
from mi_refgs.types import Color3f, Float, Vector3f


class Light(Protocol):
    """Light from far away. Lookups take unit world directions; they are traced and differentiable."""

    def specular(self, direction: Vector3f, roughness: Float) -> Color3f:
        """Radiance averaged over the GGX lobe of this roughness (α = roughness²) around the directions."""

    def irradiance(self, normal: Vector3f) -> Color3f:
        """∫ L cosθ dω / π over the hemisphere of the normals: a constant light of 1 gives 1."""

    def radiance(self, direction: Vector3f) -> Color3f:
        """Radiance that arrives from the directions, unfiltered."""


@dataclass(frozen=True)
class RotatedLight:
    """A light seen through a rotation or in a mirror, and scaled."""

    light: Light
    light_from_world: Any  # mi.Matrix3f, detached
    motion: Float | None = None  # (3,) of `kernels.motion`, of the light in the world
    scale: Float | None = None  # (3,) factor per channel, under AD

    def _looked_up(self, lookup: Callable[..., Color3f], direction: Vector3f, *more: Float) -> Color3f:
        colour = lookup(self.light_from_world @ turned_by(self.motion, mi.Vector3f(direction), -1), *more)
        return colour if self.scale is None else colour * mi.Color3f(part_of(self.scale, 0, colour))

    def specular(self, direction: Vector3f, roughness: Float) -> Color3f:
        return self._looked_up(self.light.specular, direction, roughness)

    def irradiance(self, normal: Vector3f) -> Color3f:
        return self._looked_up(self.light.irradiance, normal)

    def radiance(self, direction: Vector3f) -> Color3f:
        return self._looked_up(self.light.radiance, direction)
