"""The methods that are compared, each as a picture and as a call to be timed with its primary rays."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.view import Points, first_hits
from benchmarks.splitsum.exact import Setup
from benchmarks.splitsum.settings import ALBEDO
from mi_refgs.shade.accuracy import Accuracy
from mi_refgs.shade.lobe_matrices import LEVELS, Levels
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.split_sum import shade

SHIPPED = "shipped"


def _levels(*roughness: float) -> Levels:
    """Levels of these, each as fine as the shipped one of the next larger roughness."""
    finer = (int(np.searchsorted(LEVELS.roughness, r - 1e-6)) for r in roughness)
    return Levels(roughness, tuple(LEVELS.max_height[i] for i in finer))


LEVEL_SETS = {
    "few": _levels(0.1, 0.32, 1.0),
    SHIPPED: LEVELS,
    "many": _levels(0.07, 0.1, 0.12, 0.15, 0.18, 0.22, 0.265, 0.32, 0.38, 0.45, 0.54, 0.65, 0.8, 1.0),
}
"""Filtered levels; the map itself is one more."""

OPTIONS = {"": Accuracy(), "dominant": Accuracy(dominant=True), "multiscatter": Accuracy(multiscatter=True)}
"""Settings of `shade` that concern a surface that nothing shadows."""


def split_sum(points: Any, material: mc.Material, light: Any, option: str = "") -> Any:
    """Outgoing radiance as the product shades it."""
    surface = ShadingPoints(
        points.normal,
        points.view,
        albedo=material.albedo,
        metallic=material.metallic,
        roughness=material.roughness,
    )
    return shade(surface, light, "irradiance", OPTIONS[option]).total()


def picture_values(radiance: Any) -> np.ndarray:
    """mi.Color3f of P points as (P, 3) float64."""
    return np.array(radiance, np.float64).T


def material(metallic: float, roughness: float) -> mc.Material:
    """Opaque, with the albedo of all scenes."""
    return mc.device_material(ALBEDO, metallic, roughness)


def with_primary_rays(setup: Setup, shader: Callable[[Points], Any]) -> Callable[[], Any]:
    """A call that meets the surface at the centre of every pixel of the timed picture and shades it there."""
    size, sensor = setup.settings.timing_size, setup.timing_sensor

    def run() -> Any:
        hit, ray = first_hits(setup.scene, sensor, size)
        pixel = dr.arange(mi.UInt32, size * size)
        colour = shader(Points(size, pixel, hit.p, hit.sh_frame.n, -ray.d, hit.n))
        return dr.select(hit.is_valid(), colour, 0)

    return run
