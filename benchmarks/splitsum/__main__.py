"""Speed against error of the split-sum approximation, with Mitsuba's path tracer beside it.

    python -m benchmarks.splitsum                      every case, below 10 minutes on 2 cores
    python -m benchmarks.splitsum --small -o out       a small instance, below a minute
    python -m benchmarks.splitsum --envmap sky.exr -o out   your light beside the built-in ones

Every method shades the same pixels. Writes splitsum.json; `python -m benchmarks.pages` makes the tables and
the plot of docs/splitsum.md."""

import functools
import sys
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, timing
from benchmarks.common.errors import CLEAR, Step, decompose, noise_floor
from benchmarks.common.report import Row, benchmark, where
from benchmarks.common.setup import path_tracer
from benchmarks.common.view import make_light, rows as image_values, view_bins
from benchmarks.splitsum.setup import CONVEX, PAGE, SMALL, Exact, Settings, diffuse, reflectance, split_sum
from mi_refgs.shade.points import reflect

METHOD = "split_sum"
CASE = ("shape", "light", "roughness", "metallic")
Times = dict[tuple[str, str, str], dict[int, float]]
"""Milliseconds per megapixel by shape, light and method, then by setting."""


def line(times: dict[int, float]) -> Callable[[float], float]:
    """Time as a function of the samples: the line that fits best in relative terms, positive at 0."""
    n, t = (np.array(list(x), np.float64) for x in (times.keys(), times.values()))
    design = np.stack([1 / t, n / t], axis=1)
    (offset, slope), *_ = np.linalg.lstsq(design, np.ones(len(n)), rcond=None)
    if offset < 0 or slope < 0:
        offset, slope = 0.0, float(np.median(t / n))
    return lambda samples: float(offset + slope * samples)


def time_of(times: Times, row: Row) -> float | None:
    """Time of a row: measured, or on the straight line through the measured ones."""
    known = times.get((row["shape"], row["light"], row["method"]), {})
    if row["setting"] in known:
        return known[row["setting"]]
    return line(known)(row["setting"]) if len(known) > 1 else None


def trend(points: list[tuple[int, float, float]]) -> tuple[float, float | None]:
    """c of relMSE = c / samples through (samples, relMSE, floor), floors taken off, a mean of logarithms; and
    the slope of log relMSE over log samples, -1 for independent samples, None without two clear points."""
    clear = [(n, e - floor) for n, e, floor in points if e > CLEAR * floor]
    constant = np.exp(np.mean([np.log(n * e) for n, e in clear or [point[:2] for point in points]]))
    if len(clear) < 2:
        return float(constant), None
    x, y = np.log(np.array(clear)).T
    return float(constant), float(np.polyfit(x, y, 1)[0])


def speed_ups(rows: list[Row], times: Times) -> list[dict[str, Any]]:
    """One record for each convex shape, light and material with the finest light: samples, ratio of times.

    Where the split sum's error is below the noise floor the ratio is a lower bound, taken at the floor. The
    path tracer cannot take less than one sample."""
    found = []
    split = where(rows, method=METHOD, n_dot_v="all", shape=CONVEX)
    finest = max(row["setting"] for row in split)
    for row in where(split, setting=finest):
        case = {key: row[key] for key in CASE}
        paths = [
            (path["setting"], path["relmse"], path["relmse_floor"])
            for path in where(rows, method="path", **case)
        ]
        constant, slope = trend(paths)
        spp = constant / max(row["relmse"], CLEAR * row["relmse_floor"])
        path_ms = line(times[row["shape"], row["light"], "path"])(max(spp, 1))
        split_ms = times[row["shape"], row["light"], METHOD][row["setting"]]
        gain = {"path_spp": spp, "speed_up": path_ms / split_ms, "path_exponent": slope}
        found.append(case | {"lower_bound": row["below_floor"]} | gain)
    return found


TIMED = (0.5, 0.3)  # metallic and roughness on which times are taken; a kernel is the same for every other
Calls = dict[tuple[str, int], Callable[[], Any]]  # what makes the timed image, by method and setting


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Measure every case; returns the JSON report."""
    lights = [make_light(name, settings.truth_height) for name in settings.lights]
    rows: list[Row] = []
    scores: list[Row] = []
    found_budgets: list[Row] = []
    times: Times = {}
    materials = [(r, m) for r in settings.roughness for m in settings.metallic]
    stages = [Exact(name, light, settings) for name in settings.shapes for light in lights]
    for setup in tqdm(stages, desc="references, path tracer", disable=quiet):
        for roughness, metallic in materials:
            setup.set_material(metallic, roughness)
            seed = 1 + len(rows)
            for spp in settings.spp:
                values = setup.render(path_tracer(2), spp, seed + spp)  # stops after direct light
                rows += _errors(setup, "path", spp, roughness, metallic, values)
            score = errors.mean_score(values, setup.integrals(roughness).radiance(metallic))
            scores.append(setup.case(roughness, metallic) | {"score": score})
    # One height after the other: only a few operators are kept at a time.
    filtered = {(x.name, h): x.environment(h).prefilter() for h in settings.heights for x in lights}
    dr.eval([light.levels for light in filtered.values()])
    limits = settings.timing_seconds, settings.timing_rounds
    for setup in tqdm(stages, desc="split sum, times", disable=quiet):
        found, calls = _split_sums(setup, filtered, materials)
        rows += found
        setup.set_material(*TIMED)
        render = functools.partial(mi.render, setup.scene, sensor=setup.timing_sensor)
        for spp in settings.timed_spp:
            calls["path", spp] = functools.partial(render, integrator=path_tracer(2), spp=spp)
        for (method, setting), ms in timing.milliseconds(calls, *limits).items():
            known = times.setdefault((setup.name, setup.light.name, method), {})
            known[setting] = ms / (settings.timing_size**2 / 1e6)
    shared = {(setup.name, setup.light.name): setup for setup in stages}
    for name in tqdm(settings.budget_shapes, desc="error budget", disable=quiet):
        for light in lights:
            found_budgets += budgets(shared.get((name, light.name)) or Exact(name, light, settings))
    return {
        "settings": vars(settings),
        "frequencies": {light.name: light.frequency() for light in lights},
        "rows": [row | {"ms_per_mpx": time_of(times, row)} for row in rows],
        "scores": scores,
        "speed_ups": speed_ups(rows, times),
        "budgets": found_budgets,
    }


def _errors(
    setup: Exact, method: str, setting: int, roughness: float, metallic: float, values: np.ndarray
) -> list[Row]:
    """Return the errors of an image (P, 3), for the finest split sum also by view angle."""
    reference = setup.integrals(roughness).radiance(metallic)
    case = setup.case(roughness, metallic) | {"method": method, "setting": setting}
    masks: dict[str, Any] = {"all": None}
    if (method, setting) == (METHOD, setup.settings.heights[-1]):
        masks |= view_bins(setup.points.n_dot_v())
    return [case | {"n_dot_v": name} | errors.compare(values, reference, x) for name, x in masks.items()]


def _split_sums(
    setup: Exact, filtered: dict[tuple[str, int], Any], materials: list[tuple[float, float]]
) -> tuple[list[Row], Calls]:
    """Return the errors of the split sums of a setup, and the calls that make the timed ones."""
    rows: list[Row] = []
    calls: Calls = {}
    heights = setup.settings.heights
    for height, dominant in [*((height, False) for height in heights), (heights[-1], True)]:
        light, method = filtered[setup.light.name, height], METHOD + "_dominant" * dominant
        for roughness, metallic in materials:
            radiance = split_sum(setup.points, setup.set_material(metallic, roughness), light, dominant)
            rows += _errors(setup, method, height, roughness, metallic, image_values(radiance))
        material = setup.set_material(*TIMED)
        shader = functools.partial(split_sum, material=material, light=light, dominant=dominant)
        calls[method, height] = setup.with_primary_rays(shader)
    return rows, calls


# ---------------- error budgets: exact counterparts of one approximation after the other ----------------


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
    looked_up, resolved = (image_values(x.specular(mirror, material["roughness"])) for x in (light, finest))
    integrals = setup.integrals(roughness)
    a, b = integrals.table
    base, table = diffuse(metallic, integrals.table), f0 * a + b
    exact = base * integrals.irradiance.mean
    around = (integrals.scale.mean + integrals.bias.mean) / (a + b)
    steps = [
        Step("", image_values(split_sum(points, material, light))),
        Step("table lookup", looked_up * table + base * image_values(light.irradiance(points.normal))),
        Step("irradiance lookup", looked_up * table + exact),
        Step("light resolution", resolved * table + exact),
        Step("level interpolation", lobe * table + exact),
        Step("lobe with N = V = R", around * table + exact),
        Step("Schlick in the table", integrals.radiance(metallic).mean),
    ]
    if setup.name not in CONVEX:  # the shape's own shadow, and light that it reflects onto itself
        direct = setup.integrals(roughness, occluded=True).radiance(metallic).mean
        bounced = direct + setup.bounces(roughness, metallic)
        steps += [Step("no shadow", direct), Step("no inter-reflection", bounced)]
    return steps


if __name__ == "__main__":
    sys.exit(benchmark("splitsum", __doc__, measure, PAGE, SMALL, ("--envmap", "lights")))
