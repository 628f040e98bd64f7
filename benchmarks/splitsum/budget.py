"""Error budgets: the split sum's approximations are replaced by exact counterparts one by one."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.common.errors import Step, decompose, noise_floor
from benchmarks.common.report import Row
from benchmarks.common.view import rows
from benchmarks.splitsum.setup import CONVEX, Exact, diffuse, reflectance, split_sum
from mi_refgs.shade.points import reflect

TABLE = "table lookup"
IRRADIANCE = "irradiance lookup"
RESOLUTION = "light resolution"
LEVELS = "level interpolation"
LOBE = "lobe with N = V = R"
SCHLICK = "Schlick in the table"
SHADOW = "no shadow"
BOUNCES = "no inter-reflection"


def budgets(setup: Exact) -> list[Row]:
    """Budgets of every roughness and metal of a shape under a light, with the finest light."""
    settings = setup.settings
    light = setup.light.prefiltered(settings.heights[-1])
    finest = setup.light.prefiltered(settings.truth_height)
    found = []
    for roughness in settings.roughness:
        around = setup.prefiltered(roughness).mean
        for metallic in settings.budget_metallic:
            steps = _chain(setup, roughness, metallic, light, finest, around)
            reference = setup.integrals(roughness).radiance(metallic)
            row = setup.case(roughness, metallic)
            row["floor"] = noise_floor(reference.error, reference.mean)
            found.append(row | decompose(steps))
    return found


def _chain(
    setup: Exact, roughness: float, metallic: float, light: Any, finest: Any, lobe: np.ndarray
) -> list[Step]:
    """From the product's own image to the exact one; `lobe`: the exact average around the mirror."""
    points, f0 = setup.points, reflectance(metallic)
    material = setup.set_material(metallic, roughness)
    mirror = reflect(points.view, points.normal)
    looked_up, resolved = (rows(x.specular(mirror, material["roughness"])) for x in (light, finest))
    integrals = setup.integrals(roughness)
    a, b = integrals.table
    base, table = diffuse(metallic, integrals.table), f0 * a + b
    exact = base * integrals.irradiance.mean
    around = (integrals.scale.mean + integrals.bias.mean) / (a + b)
    steps = [
        Step("", rows(split_sum(points, material, light))),
        Step(TABLE, looked_up * table + base * rows(light.irradiance(points.normal))),
        Step(IRRADIANCE, looked_up * table + exact),
        Step(RESOLUTION, resolved * table + exact),
        Step(LEVELS, lobe * table + exact),
        Step(LOBE, around * table + exact),
        Step(SCHLICK, integrals.radiance(metallic).mean),
    ]
    if setup.name not in CONVEX:  # the shape's own shadow, and light that it reflects onto itself
        direct = setup.integrals(roughness, occluded=True).radiance(metallic).mean
        steps += [Step(SHADOW, direct), Step(BOUNCES, direct + setup.bounces(roughness, metallic))]
    return steps
