"""Lights: the protocol of three lookups that reflectance models use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import mitsuba as mi


class Light(Protocol):
    """Light from far away. Lookups take unit world directions; they are traced and differentiable."""

    def specular(self, direction: mi.Vector3f, roughness: mi.Float) -> mi.Color3f:
        """Radiance averaged over the GGX lobe of this roughness (α = roughness²) around the directions."""

    def irradiance(self, normal: mi.Vector3f) -> mi.Color3f:
        """∫ L cosθ dω / π over the hemisphere of the normals: a constant light of 1 gives 1."""

    def radiance(self, direction: mi.Vector3f) -> mi.Color3f:
        """Radiance that arrives from the directions, unfiltered."""


@dataclass(frozen=True)
class RotatedLight:
    """A light seen through a rotation or in a mirror."""

    light: Light
    light_from_world: Any  # mi.Matrix3f, detached

    def specular(self, direction: Any, roughness: Any) -> Any:
        return self.light.specular(self.light_from_world @ mi.Vector3f(direction), roughness)

    def irradiance(self, normal: Any) -> Any:
        return self.light.irradiance(self.light_from_world @ mi.Vector3f(normal))

    def radiance(self, direction: Any) -> Any:
        return self.light.radiance(self.light_from_world @ mi.Vector3f(direction))
