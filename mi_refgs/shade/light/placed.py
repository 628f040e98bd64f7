"""A known environment map whose rotation and scale a fit learns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.motion import motion_of
from mi_refgs.shade.light.envmap import EnvironmentLight, FittedLight
from mi_refgs.shade.light.light import Light, RotatedLight
from mi_refgs.types import Float, TensorXf

SMALLEST = 1e-6  # radians: a rotation's axis is defined and has derivatives from here on


@dataclass(frozen=True)
class PlacedLight(FittedLight):
    """An environment map of raw values `raw`, rotated and scaled by `placement` (1, 6), under AD.

    placement: rotation vector of the map in the world (axis times radians), then the logarithm of the scale
    per channel. Three numbers without bounds have derivatives everywhere but at turns of 360°; a quaternion
    has a fourth, which its length makes redundant. learn: as in `Known`; other numbers count as 0.
    """

    placement: TensorXf
    learn: tuple[str, ...]

    @property
    def map(self) -> EnvironmentLight:
        return EnvironmentLight(self.raw)

    @property
    def saved_height(self) -> int:
        return 2 * self.map.height  # a rotated map of as many rows would be blurred

    def placed(self, light: Light) -> RotatedLight:
        turn, scale = self.rotation(), self.scale()
        motion = motion_of(turn)
        dr.eval(turn, motion, scale)  # lookups may be in a loop, which cannot evaluate
        return RotatedLight(light, dr.detach(turn).T, motion, scale)

    def rotation(self) -> Any:
        """Matrix from directions in the map to the world, mi.Matrix3f."""
        entry = [dr.gather(mi.Float, self.placement.array, i) for i in range(3)]
        about = [entry[i] if "rotation" in self.learn else mi.Float(0) for i in range(3)]
        if "azimuth" in self.learn:
            about[2] = entry[2]
        vector = mi.Vector3f(*about)
        angle = dr.sqrt(dr.squared_norm(vector) + SMALLEST**2)
        axis = vector * (dr.sin(0.5 * angle) / angle)
        return dr.quat_to_matrix(mi.Matrix3f, mi.Quaternion4f(*axis, dr.cos(0.5 * angle)))

    def scale(self) -> Float:
        """Factor of the radiance per channel (3,)."""
        index = {"scale": [3, 3, 3], "colour": [3, 4, 5]}
        used = next((index[name] for name in self.learn if name in index), None)
        if used is None:
            return dr.opaque(mi.Float, 1, 3)
        return dr.exp(dr.gather(mi.Float, self.placement.array, mi.UInt32(used)))

    def record(self) -> dict[str, list[float]]:
        """Rotation matrix from the map to the world, row by row, and scale per channel."""
        turn = np.array(self.rotation(), np.float64).reshape(3, 3)
        return {"world_from_map": turn.round(6).tolist(), "scale": self.scale().numpy().round(6).tolist()}

    def prefilter(self) -> Light:
        return self.placed(self.map.prefilter())

    def unfiltered(self) -> Light:
        return self.placed(self.map.unfiltered())

    def unusable(self) -> int:
        return super().unusable() + int(np.count_nonzero(~np.isfinite(self.placement.numpy())))
