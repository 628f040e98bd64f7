"""A light that is the same from everywhere, and whose colour a fit learns."""

from dataclasses import dataclass, field
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import upload_tensor
from mi_refgs.shade.light.envmap import bounded, nearest_raw, softplus
from mi_refgs.shade.light.kind import RADIANCE, FittedLight, LightKind
from mi_refgs.types import Color3f, Float, TensorXf, Vector3f


@dataclass(frozen=True)
class ConstantLight:
    """The same radiance (mi.Color3f, under AD) from everywhere, which no filter changes."""

    colour: Color3f

    def specular(self, direction: Vector3f, roughness: Float = None) -> Color3f:
        return mi.Color3f(self.colour)

    radiance = irradiance = specular


class LearntColour(FittedLight):
    """A constant light: `raw` is a tensor (1, 3), radiance = softplus(raw)."""

    def prefilter(self) -> ConstantLight:
        colour = bounded(softplus(self.raw.array), self.raw.array)
        return ConstantLight(mi.Color3f(*(dr.gather(mi.Float, colour, i) for i in range(3))))


@dataclass(frozen=True)
class Constant(LightKind):
    """The same light from everywhere, of one colour."""

    radiance: float = field(default=0.5, metadata=RADIANCE)  # initial

    name: ClassVar[str] = "constant"

    def start(self) -> TensorXf:
        return upload_tensor(nearest_raw(np.full((1, 3), self.radiance)))

    def of(self, raw: TensorXf) -> LearntColour:
        return LearntColour(raw)
