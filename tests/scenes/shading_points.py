"""Random shading points, and their radiance by the float64 reference."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.reference import shade as reference
from mi_refgs.shade import brdf
from mi_refgs.shade.light.lobe_matrices import LEVEL_ROUGHNESS
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from tests.helpers import unit

N = 50


def shading_values(rng: np.random.Generator, occlusion: str) -> dict[str, Any]:
    """Points whose normals face the camera, away from the clamps; normals and views need not have unit
    length."""
    view = unit(rng.normal(size=(N, 3)))
    normal = unit(unit(rng.normal(size=(N, 3))) + 1.3 * view)
    return {
        "normal": normal * rng.uniform(0.5, 2, (N, 1)),
        "view": view * rng.uniform(0.5, 2, (N, 1)),
        "albedo": rng.uniform(0.1, 0.9, (N, 3)),
        "metallic": rng.uniform(0.1, 0.9, N),
        "roughness": rng.uniform(0.05, 0.95, N),
        "radiance": rng.uniform(0.1, 2, (N, 3)),
        "visibility": None if occlusion == "open" else rng.uniform(0, 1, N),
        "indirect": rng.uniform(0.1, 1, (N, 3)) if occlusion == "indirect" else None,
        "ambient": rng.uniform(0, 2, (N, 3)) if occlusion == "ambient" else None,
    }


def points_of(values: dict[str, Any]) -> ShadingPoints:
    def array(x: Any) -> Any:
        if x is None:
            return None
        return mi.Float(x.astype(np.float32)) if x.ndim == 1 else mi.Vector3f(x.T.astype(np.float32))

    arrays = {name: array(x) for name, x in values.items()}
    for name in ("albedo", "radiance", "indirect", "ambient"):
        arrays[name] = None if arrays.get(name) is None else mi.Color3f(arrays[name])
    return ShadingPoints(**arrays)


def exact_shade(levels: list[np.ndarray], **values: Any) -> np.ndarray:
    """Terms (3, 3) of one point by `reference.shade`, with the table and the levels of the program."""
    return reference.shade(brdf.table().astype(np.float64), levels, LEVEL_ROUGHNESS, **values)


def exact_terms(
    values: dict[str, Any], levels: list[np.ndarray], options: ShadingOptions, k: int
) -> np.ndarray:
    """Terms (3, 3) of point k."""
    chosen = {name: getattr(options, name) for name in ("diffuse", "dominant", "multiscatter")}
    one = {name: None if x is None else x[k] for name, x in values.items()}
    return exact_shade(levels, **chosen, **one)
