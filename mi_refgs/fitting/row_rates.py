"""Learning rates by row: what a surfel or a texel is decides how fast it learns. A `RowRate` turns the rate η
of a tensor into those of its entries, from all parameters by name, and its own name."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_refgs.surfels.table import sigmoid
from mi_refgs.types import Float, TensorXf

Params = Mapping[str, TensorXf]
RowRate = Callable[[Float, Params, str], Float]
LEAST_DIFFUSE = 0.05  # 1 - metallic below which rates rise no further: of a metal of `metal_evidence`


def relative(η: Float, params: Params, name: str) -> Float:
    """Values above 1 learn at the rate times themselves: lamps grow exponentially."""
    return η * dr.maximum(dr.detach(params[name].array), 1)


def of_mirrors(η: Float, params: Params, name: str) -> Float:
    """Rows learn at the rate times metallic (1 - roughness)²: others reflect no normals."""
    smooth = 1 - _material(params, name, "roughness", 0)
    return η * _material(params, name, "metallic", 1) * dr.square(smooth)


def of_diffuse_colour(η: Float, params: Params, name: str) -> Float:
    """Rows learn at the rate over 1 - metallic, by which their colour is displayed."""
    return η / dr.maximum(1 - _material(params, name, "metallic", 0), LEAST_DIFFUSE)


@dataclass(frozen=True)
class ByDistance:
    """Rows of positions learn at the rate times their distance from the centre, in this unit."""

    centre: tuple[float, ...]  # (3,)
    unit: float

    def __call__(self, η: Float, params: Params, name: str) -> Float:
        p = dr.detach(params[name].array)
        row = dr.arange(mi.UInt32, dr.width(p)) // 3 * 3  # of each entry
        offset = [dr.gather(mi.Float, p, row + k) - dr.opaque(mi.Float, x) for k, x in enumerate(self.centre)]
        return η * dr.norm(mi.Vector3f(*offset)) / dr.opaque(mi.Float, self.unit)


def _material(params: Params, name: str, material: str, absent: float) -> Float:
    """A material of the surfel of each entry; `absent` if these, such as a background's, have none."""
    values = params.get(name[: max(name.rfind("."), name.rfind("/")) + 1] + material)
    if values is None or values.shape[0] != params[name].shape[0]:
        return mi.Float(absent)
    row = dr.arange(mi.UInt32, math.prod(params[name].shape)) // params[name].shape[-1]
    return sigmoid(dr.gather(mi.Float, dr.detach(values.array), row))
