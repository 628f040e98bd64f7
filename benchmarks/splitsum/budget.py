"""Error budgets: the split sum's approximations replaced one by one, and what surfels add to the error.

Surfels: a sphere of two materials in bands, covered with them, against the sphere. Blending before shading
mixes materials where bands meet; blended normals are not the surface's; coverage is not exactly 1, and a band
ends at a surfel's edge. Each is replaced in turn, and the split sum itself comes last.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common.errors import Step, decompose, noise_floor
from benchmarks.common.report import Row
from benchmarks.common.setup import ALBEDO, covering
from benchmarks.common.view import rows
from benchmarks.splitsum.setup import CONVEX, Exact, diffuse, reflectance, split_sum
from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.render.pipeline import SurfelScene, render
from mi_refgs.shade.points import reflect
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera, splat
from mi_refgs.surfels.table import Surfels

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


SHAPE = "sphere"
BLENDING = "deferred blending"
NORMALS = "surfel normals"
COVERAGE = "surfel coverage and edges"
SPLIT_SUM = "split sum itself"

MATERIALS = ((1.0, 0.2), (0.0, 0.6))
"""(metallic, roughness) of even and odd bands: polished metal and dull plastic."""
BANDS = 6
"""Bands from pole to pole, of equal area."""


def band(y: np.ndarray) -> np.ndarray:
    """Material (0 or 1) at heights -1 … 1."""
    return np.floor((np.clip(y, -1, 0.999999) + 1) * (BANDS / 2)).astype(int) % 2


def sphere_surfels(count: int) -> Surfels:
    """Surfels evenly on the unit sphere, with its exact normals and the materials of its bands."""
    i = np.arange(count) + 0.5
    y, φ = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    sine = np.sqrt(1 - y * y)
    points = np.stack([sine * np.cos(φ), y, sine * np.sin(φ)], axis=-1)
    metallic, roughness = np.array(MATERIALS)[band(y)].T[..., None]
    return covering(points, points, albedo=ALBEDO, metallic=metallic, roughness=roughness)


def surfel_budget(setup: Exact) -> dict[str, Any]:
    """Budget of the surfels' image of a sphere, where they cover its pixels."""
    settings = setup.settings
    height = settings.heights[-1]
    light = setup.light.prefiltered(height)
    surfels = sphere_surfels(settings.surfels)
    camera = Camera.from_sensor(setup.sensor.inner)
    shading = Shading(at="pixel", reflectance="split_sum", diffuse="irradiance")
    shipped = setup.points.of_image(rows(render(SurfelScene(surfels, shading, light), camera).radiance))

    group = mi.Float(band(surfels.to_numpy()["position"][:, 1]).astype(np.float32))
    blended = splat(surfels, [*surfels.frame()[2], group], camera)
    maps = np.stack([np.array(x, np.float64) for x in (*blended.features, blended.alpha)], axis=-1)
    normal, odd, alpha = np.split(maps[setup.points.pixel.numpy()], [3, 4], axis=1)
    covered = alpha[:, 0] > COVERAGE_FLOOR
    share = np.concatenate([alpha - odd, odd], axis=1)

    facing = np.where(np.sum(normal * rows(setup.points.view), -1, keepdims=True) < 0, -normal, normal)
    by_surfel = _shaded(setup, light, facing)
    by_mesh = _shaded(setup, light, rows(setup.points.normal))
    here = band(rows(setup.points.position)[:, 1])
    exact = [setup.integrals(roughness).radiance(metallic) for metallic, roughness in MATERIALS]
    steps = [
        Step("", shipped),
        Step(BLENDING, _mixed(by_surfel, share)),
        Step(NORMALS, _mixed(by_mesh, share)),
        Step(COVERAGE, _chosen(by_mesh, here)),
        Step(SPLIT_SUM, _chosen([estimate.mean for estimate in exact], here)),
    ]
    noise = _chosen([estimate.error for estimate in exact], here)[covered]
    found = decompose([Step(step.replaced, step.values[covered]) for step in steps])
    return {
        "light": setup.light.name,
        "height": height,
        "surfels": settings.surfels,
        "covered": float(covered.mean()),
        "floor": noise_floor(noise, steps[-1].values[covered]),
        **found,
    }


def _shaded(setup: Exact, light: Any, normal: np.ndarray) -> list[np.ndarray]:
    """The split sum of each material with these normals (P, 3)."""
    facing = mi.Vector3f(np.ascontiguousarray(normal.T, dtype=np.float32))
    dr.eval(facing)
    turned = replace(setup.points, normal=facing)
    return [rows(split_sum(turned, setup.set_material(*m), light)) for m in MATERIALS]


def _mixed(values: list[np.ndarray], share: np.ndarray) -> np.ndarray:
    return values[0] * share[:, :1] + values[1] * share[:, 1:]


def _chosen(values: list[np.ndarray], which: np.ndarray) -> np.ndarray:
    return np.where(which[:, None] == 0, values[0], values[1])
