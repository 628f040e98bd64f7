"""The split sum's error taken apart: one approximation after the other replaced by its exact counterpart."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from benchmarks.common.budget import Row, Step, decompose, noise_floor
from benchmarks.common.view import rows
from benchmarks.splitsum.exact import Exact, diffuse, reflectance, split_sum
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


def budgets(setup: Exact) -> list[Row]:
    """Budgets of every roughness and metal of a shape under a light, at the default height and the finest."""
    settings = setup.settings
    heights = sorted({settings.height, settings.heights[-1]})
    lights = {height: setup.light.prefiltered(height) for height in heights}
    finest = setup.light.prefiltered(settings.truth_height)
    found = []
    for roughness in settings.roughness:
        around = setup.prefiltered(roughness).mean
        for height, metallic in itertools.product(heights, settings.budget_metallic):
            steps = _chain(setup, roughness, metallic, lights[height], finest, around)
            reference = setup.integrals(roughness).radiance(metallic)
            row = setup.case(roughness, metallic) | {"height": height}
            row["floor"] = noise_floor(reference.error, reference.mean)
            found.append(row | decompose(steps).record())
    return found


def _chain(
    setup: Exact, roughness: float, metallic: float, light: Any, finest: Any, lobe: np.ndarray
) -> list[Step]:
    """From the product's own picture to the exact one; `lobe`: the exact average around the mirror."""
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
    return steps if setup.name in CONVEX else steps + _concave(setup, roughness, metallic)


def _concave(setup: Exact, roughness: float, metallic: float) -> list[Step]:
    """What the shape itself adds: its shadow, and light that it reflects onto itself."""
    direct = setup.integrals(roughness, occluded=True).radiance(metallic).mean
    further = setup.bounces(roughness, metallic)
    return [Step(SHADOW, direct), Step(BOUNCES, direct + further)]
