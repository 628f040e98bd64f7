"""A known environment map whose rotation and scale a fit learns."""

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.motion import motion_of
from mi_refgs.shade.light.envmap import EnvironmentLight, FittedLight
from mi_refgs.shade.light.latlong import lat_long
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.types import TensorXf

SMALLEST = 1e-6  # radians: a rotation has an axis, and derivatives, from here on


@dataclass(frozen=True)
class PlacedLight(FittedLight):
    """An environment map of raw values `raw` with a rotation and a scale under AD, or without (None)."""

    # (1, 3) axis times radians: free numbers in all directions, as gravity is unknown to most cameras.
    rotation: TensorXf | None = None
    # (1, 3) logarithm per channel: probe and camera differ in exposure and white balance.
    scale: TensorXf | None = None

    @property
    def map(self) -> EnvironmentLight:
        return EnvironmentLight(self.raw)

    def placed(self, light: Light) -> RotatedLight:
        """A lookup of `map` with the rotation and scale."""
        turn = self.world_from_map()
        motion = None if self.rotation is None else motion_of(turn)
        scale = None if self.scale is None else dr.exp(self.scale.array)
        dr.eval(turn, motion, scale)  # lookups may be in a loop, which cannot evaluate
        return RotatedLight(light, dr.detach(turn).T, motion, scale)

    def world_from_map(self) -> Any:
        """The rotation, a mi.Matrix3f."""
        if self.rotation is None:
            return mi.Matrix3f(1)
        vector = mi.Vector3f(*(dr.gather(mi.Float, self.rotation.array, i) for i in range(3)))
        angle = dr.sqrt(dr.squared_norm(vector) + SMALLEST**2)
        axis = vector * (dr.sin(0.5 * angle) / angle)
        return dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(*axis, dr.cos(0.5 * angle)))

    def prefilter(self) -> Light:
        return self.placed(self.map.prefilter())

    def unfiltered(self) -> Light:
        return self.placed(self.map.unfiltered())

    def environment(self) -> EnvironmentLight:
        """The map in the world, with twice the rows: with as many, it would be blurred."""
        return EnvironmentLight.from_radiance(lat_long(self.unfiltered().radiance, 2 * self.map.height, 1))
