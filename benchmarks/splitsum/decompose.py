"""The split sum's error taken apart: one approximation after the other replaced by its exact counterpart."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common.budget import Step, decompose, noise_floor
from benchmarks.splitsum import methods
from benchmarks.splitsum.exact import Setup, diffuse, reflectance
from benchmarks.splitsum.settings import CONVEX
from mi_refgs.shade.points import reflect

TABLE = "table lookup"
IRRADIANCE = "irradiance lookup"
RESOLUTION = "light resolution"
LEVELS = "level interpolation"
LOBE = "lobe with N = V = R"
SCHLICK = "Schlick in the table"
SHADOW = "no shadow"
BOUNCES = "no inter-reflection"


def budgets(setup: Setup) -> list[dict[str, Any]]:
    """Budgets of every roughness and metal of a shape under a light, at the default height and the finest."""
    settings = setup.settings
    heights = sorted({settings.height, settings.heights[-1]})
    lights = {height: setup.light.prefiltered(height) for height in heights}
    finest = setup.light.prefiltered(settings.truth_height)
    found = []
    for roughness in settings.roughness:
        around = setup.prefiltered(roughness).mean
        for height in heights:
            lookups = _lookups(setup, roughness, lights[height], finest, around)
            for metallic in settings.budget_metallic:
                steps = _chain(setup, roughness, metallic, lights[height], lookups)
                found.append(
                    {
                        "shape": setup.name,
                        "light": setup.light.name,
                        "roughness": roughness,
                        "metallic": metallic,
                        "height": height,
                        "floor": _noise(setup, roughness, metallic),
                        **decompose(steps).record(),
                    }
                )
    return found


def _lookups(
    setup: Setup, roughness: float, shipped: Any, finest: Any, around: np.ndarray
) -> dict[str, np.ndarray]:
    """What the chains of all metals share: radiance around the mirror direction in three qualities."""
    points = setup.points
    mirror = reflect(points.view, points.normal)
    r = dr.opaque(mi.Float, roughness)
    return {
        "shipped": methods.picture_values(shipped.specular(mirror, r)),
        "finest": methods.picture_values(finest.specular(mirror, r)),
        "exact": around,
        "irradiance": methods.picture_values(shipped.irradiance(points.normal)),
    }


def _chain(
    setup: Setup, roughness: float, metallic: float, shipped: Any, lookups: dict[str, np.ndarray]
) -> list[Step]:
    """From the product's own picture to the exact one."""
    f0 = reflectance(metallic)
    values = methods.picture_values(
        methods.split_sum(setup.points, methods.material(metallic, roughness), shipped)
    )
    integrals = setup.integrals(roughness)
    a, b = integrals.table
    base = diffuse(metallic, integrals.table)
    looked_up, exact = base * lookups["irradiance"], base * integrals.irradiance.mean
    around = (integrals.scale.mean + integrals.bias.mean) / (a + b)
    table = f0 * a + b
    steps = [
        Step("", values),
        Step(TABLE, lookups["shipped"] * table + looked_up),
        Step(IRRADIANCE, lookups["shipped"] * table + exact),
        Step(RESOLUTION, lookups["finest"] * table + exact),
        Step(LEVELS, lookups["exact"] * table + exact),
        Step(LOBE, around * table + exact),
        Step(SCHLICK, integrals.radiance(metallic).mean),
    ]
    return steps if setup.name in CONVEX else steps + _concave(setup, roughness, metallic)


def _concave(setup: Setup, roughness: float, metallic: float) -> list[Step]:
    """What the shape itself adds: its shadow, and light that it reflects onto itself."""
    direct = setup.integrals(roughness, occluded=True).radiance(metallic).mean
    further = setup.bounces(roughness, metallic)
    return [Step(SHADOW, direct), Step(BOUNCES, direct + further)]


def _noise(setup: Setup, roughness: float, metallic: float) -> float:
    """relMSE below which a part or a whole cannot be told from the references' noise."""
    reference = setup.integrals(roughness).radiance(metallic)
    return noise_floor(reference.error, reference.mean)
