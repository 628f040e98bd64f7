"""Random shading points, and their radiance by the float64 reference."""

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.reference import models
from mi_refgs.reference.light import Light
from mi_refgs.shade import brdf
from mi_refgs.shade.light.envmap import PrefilteredLight
from mi_refgs.shade.light.lobe_matrices import LEVEL_ROUGHNESS
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from tests.helpers import level_maps, unit, vector

N = 40
RANGES: dict[str, tuple[float, float, tuple[int, ...]]] = {
    "albedo": (0.1, 0.9, (3,)),
    "metallic": (0.1, 0.9, ()),
    "roughness": (0.05, 0.95, ()),
    "tint": (0.1, 0.9, (3,)),
    "radiance": (0.1, 2, (3,)),
    "visibility": (0, 1, ()),
    "indirect": (0.1, 1, (3,)),
    "residual": (-0.09, 1, (3,)),
    "ambient": (0, 2, (3,)),
    "incident": (-0.5, 0.5, (9, 3)),
}
"""Lowest and highest value of attributes, away from the clamps, and their shape per point."""


def shading_values(rng: np.random.Generator, names: Sequence[str], count: int = N) -> dict[str, np.ndarray]:
    """Attributes (count, …) of points whose normals face the camera; normals and views of any length."""
    view = unit(rng.normal(size=(count, 3)))
    normal = unit(unit(rng.normal(size=(count, 3))) + 1.3 * view)
    length = rng.uniform(0.5, 2, (2, count, 1))
    found = {"normal": normal * length[0], "view": view * length[1]}
    for name in names:
        if name == "free":  # one bit per direction of the hemisphere
            found[name] = rng.integers(0, 2**16, count)
        else:
            least, most, shape = RANGES[name]
            found[name] = rng.uniform(least, most, (count, *shape))
    return found


def points_of(values: dict[str, np.ndarray]) -> ShadingPoints:
    def array(name: str, x: np.ndarray) -> Any:
        if x.dtype.kind == "i":
            return mi.UInt64(x.astype(np.uint64))
        if x.ndim == 1:
            return mi.Float(x.astype(np.float32))
        if x.ndim == 3:
            return [mi.Color3f(vector(x[:, i])) for i in range(x.shape[1])]
        return vector(x) if name in ("normal", "view") else mi.Color3f(vector(x))

    return ShadingPoints(**{name: array(name, x) for name, x in values.items()})


def exact_light(light: PrefilteredLight) -> Light:
    """The float64 reference's light, with the table and the levels of the product."""
    return Light(level_maps(light), LEVEL_ROUGHNESS, brdf.table().astype(np.float64))


def exact_terms(values: dict[str, Any], light: Light, options: ShadingOptions) -> np.ndarray:
    """Diffuse, specular and indirect radiance (n, 3, 3) of points: arrays (n, …) by name, or None."""
    free = values["free"][:, None] >> np.arange(options.directions) & 1 if "free" in values else None
    chosen = models.Options(options.diffuse, options.dominant, options.directions, free)
    points = models.Points.of({name: x for name, x in values.items() if name != "free"})
    return np.stack(models.MODELS[options.reflectance](points, light, chosen, []), axis=1)
