"""The experiment: errors and times of every method, from one run and on the same pixels."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, report, timing
from benchmarks.common import montecarlo as mc
from benchmarks.common.lights import Light, make_light
from benchmarks.common.view import Points, view_bins
from benchmarks.splitsum import decompose, methods, surfels
from benchmarks.splitsum.exact import Setup
from benchmarks.splitsum.settings import Settings
from benchmarks.splitsum.speedup import line, speed_ups
from mi_refgs.shade.lobe_matrices import Levels

ALL = "all"
LEVELS_HEIGHT = 128
"""Rows of the light for other sets of levels: enough that its resolution does not hide them."""
TIMED_METALLIC, TIMED_ROUGHNESS = 0.5, 0.3
"""The material on which times are taken; a kernel is the same for every other."""


@dataclass
class Run:
    """What a run collects; `rows` and the rest go to JSON as they are."""

    settings: Settings
    rows: list[dict[str, Any]] = field(default_factory=list)
    times: dict[tuple[str, str, str, int], float] = field(default_factory=dict)  # ms per megapixel
    prefilter_ms: list[dict[str, Any]] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)
    budgets: list[dict[str, Any]] = field(default_factory=list)
    surfel_budgets: list[dict[str, Any]] = field(default_factory=list)
    flip_reason: str = ""

    def time(self, setup: Setup, calls: dict[tuple[str, int], Callable[[], Any]]) -> None:
        """Book the times of calls by (method, setting) that make the timed picture."""
        megapixels = self.settings.timing_size**2 / 1e6
        for key, ms in timing.milliseconds(calls, self.settings.timing_seconds).items():
            self.times[(setup.name, setup.light.name, *key)] = ms / megapixels

    def add(
        self, setup: Setup, method: str, setting: int, roughness: float, metallic: float, values: np.ndarray
    ) -> None:
        """Book the errors of a picture (P, 3), for the split sum also by view angle."""
        reference = setup.integrals(roughness).radiance(metallic)
        points = setup.points
        flip, self.flip_reason = errors.flip(points.image(values), points.image(reference.mean))
        masks: dict[str, Any] = {ALL: None}
        if method.startswith("split_sum"):
            masks |= view_bins(points.n_dot_v())
        for name, mask in masks.items():
            found = errors.compare(values, reference, mask)
            self.rows.append(
                {
                    "shape": setup.name,
                    "light": setup.light.name,
                    "roughness": roughness,
                    "metallic": metallic,
                    "method": method,
                    "setting": setting,
                    "n_dot_v": name,
                    "bias": found.bias,
                    "bias_floor": found.bias_floor,
                    "relmse": found.relmse,
                    "relmse_floor": found.relmse_floor,
                    "below_floor": found.below_floor,
                    "mape": found.mape,
                    "flip": flip if mask is None else None,
                }
            )


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Run it all; what comes back is the JSON report."""
    begin = time.perf_counter()
    lights = [make_light(name, settings.truth_height) for name in settings.lights]
    run = Run(settings)
    materials = [(r, m) for r in settings.roughness for m in settings.metallic]
    stages = [Setup(name, light, settings) for name in settings.shapes for light in lights]

    for setup in tqdm(stages, desc="references, path tracer, Monte Carlo", disable=quiet):
        for roughness, metallic in materials:
            _sampled(run, setup, roughness, metallic)
    for levels in (methods.SHIPPED, *settings.level_sets):
        variants = [variant for variant in _variants(settings) if variant.levels == levels]
        filtered = _prefilter(run, lights, variants)
        for setup in tqdm(stages, desc=f"split sum, times ({levels})", disable=quiet):
            calls = _split_sums(run, setup, variants, filtered, materials)
            if levels == methods.SHIPPED:
                calls |= _sampled_calls(run, setup)
            run.time(setup, calls)
    shared = {(setup.name, setup.light.name): setup for setup in stages}
    for name in tqdm(settings.budget_shapes, desc="error budget", disable=quiet):
        for light in lights:
            setup = shared.get((name, light.name)) or Setup(name, light, settings)
            run.budgets += decompose.budgets(setup)
            if name == surfels.SHAPE:
                run.surfel_budgets.append(surfels.budget(setup))
    return {
        "machine": report.machine(),
        "settings": vars(settings),
        "seconds": time.perf_counter() - begin,
        "frequencies": {light.name: light.frequency() for light in lights},
        "pixels": {setup.name: setup.points.count for setup in stages},
        "rows": [_timed(run, row) for row in run.rows],
        "times": [
            {"shape": s, "light": n, "method": method, "setting": k, "ms_per_mpx": ms}
            for (s, n, method, k), ms in run.times.items()
        ],
        "prefilter_ms": run.prefilter_ms,
        "scores": run.scores,
        "speed_ups": speed_ups(run.rows, run.times, settings),
        "budgets": run.budgets,
        "surfel_budgets": run.surfel_budgets,
        "flip_reason": run.flip_reason,
    }


def _timed(run: Run, row: dict[str, Any]) -> dict[str, Any]:
    """A row with its time: measured, or on the straight line through the measured ones."""
    key = (row["shape"], row["light"], row["method"])
    exact = run.times.get((*key, row["setting"]))
    if exact is None:
        known = {k[3]: ms for k, ms in run.times.items() if k[:3] == key}
        exact = line(known)(row["setting"]) if len(known) > 1 else None
    return {**row, "ms_per_mpx": exact}


# ---------------- errors ----------------


def _sampled(run: Run, setup: Setup, roughness: float, metallic: float) -> None:
    """Pictures of the path tracer and of plain Monte Carlo."""
    settings = run.settings
    setup.set_material(metallic, roughness)
    material = methods.material(metallic, roughness)
    seed = 1 + len(run.rows)
    for spp in settings.spp:
        image = mi.render(setup.scene, sensor=setup.sensor, integrator=setup.direct, spp=spp, seed=seed + spp)
        values = setup.points.of_image(image)
        run.add(setup, "path", spp, roughness, metallic, values)
    reference = setup.integrals(roughness).radiance(metallic)
    run.scores.append(
        {
            "shape": setup.name,
            "light": setup.light.name,
            "roughness": roughness,
            "metallic": metallic,
            "score": errors.mean_score(values, reference),
        }
    )
    if metallic != settings.metallic[len(settings.metallic) // 2]:
        return  # plain Monte Carlo only serves the plots of speed against error, which show one metal
    for samples in settings.samples:
        count, stream = (dr.opaque(mi.UInt32, n) for n in (samples, seed + samples))
        found = mc.monte_carlo(setup.points, material, setup.emitter, count, stream)
        run.add(setup, "monte_carlo", samples, roughness, metallic, methods.picture_values(found))


@dataclass(frozen=True)
class Variant:
    """A split sum: levels, rows of the light, and a option of `shade`."""

    levels: str
    height: int
    option: str = ""

    @property
    def method(self) -> str:
        """Its name in the report."""
        levels = "" if self.levels == methods.SHIPPED else f"_{self.levels}_levels"
        return f"split_sum{levels}" + (f"_{self.option}" if self.option else "")


def _variants(settings: Settings) -> list[Variant]:
    shipped = [Variant(methods.SHIPPED, height) for height in settings.heights]
    options = [
        Variant(methods.SHIPPED, height, option)
        for height in {settings.height, settings.heights[-1]}
        for option in methods.OPTIONS
        if option
    ]
    levels = [Variant(name, min(LEVELS_HEIGHT, settings.heights[-1])) for name in settings.level_sets]
    return sorted(shipped + options, key=lambda variant: variant.height) + levels


def _prefilter(run: Run, lights: list[Light], variants: list[Variant]) -> dict[tuple[str, int], Any]:
    """Every light at every height, by (light, height), with one set of levels; books the time it takes."""
    filtered, calls = {}, {}
    for variant in (variant for variant in variants if not variant.option):
        levels = methods.LEVEL_SETS[variant.levels]
        environments = {light.name: light.environment(variant.height) for light in lights}
        for name, environment in environments.items():
            filtered[name, variant.height] = environment.prefilter(levels)

        def again(environment: Any = environments[lights[0].name], levels: Levels = levels) -> Any:
            return environment.prefilter(levels).levels

        calls[variant.method, variant.height] = again
    dr.eval([light.levels for light in filtered.values()])
    # One height after the other: only a few operators are kept at a time.
    for (method, height), call in calls.items():
        ms = timing.milliseconds({0: call}, run.settings.timing_seconds)[0]
        run.prefilter_ms.append({"method": method, "height": height, "ms": ms})
    return filtered


def _split_sums(
    run: Run, setup: Setup, variants: list[Variant], filtered: dict[tuple[str, int], Any], materials: Any
) -> dict[tuple[str, int], Callable[[], Any]]:
    """Book pictures of the split sums of a setup; calls that make the timed ones."""
    timed = methods.material(TIMED_METALLIC, TIMED_ROUGHNESS)
    calls = {}
    for variant in variants:
        light = filtered[setup.light.name, variant.height]

        def shader(points: Points, light: Any = light, option: str = variant.option) -> Any:
            return methods.split_sum(points, timed, light, option)

        for roughness, metallic in materials:
            material = methods.material(metallic, roughness)
            radiance = methods.split_sum(setup.points, material, light, variant.option)
            values = methods.picture_values(radiance)
            run.add(setup, variant.method, variant.height, roughness, metallic, values)
        calls[variant.method, variant.height] = methods.with_primary_rays(setup, shader)
    return calls


def _sampled_calls(run: Run, setup: Setup) -> dict[tuple[str, int], Callable[[], Any]]:
    """Calls that make the timed pictures of the path tracer and of plain Monte Carlo."""
    setup.set_material(TIMED_METALLIC, TIMED_ROUGHNESS)
    material = methods.material(TIMED_METALLIC, TIMED_ROUGHNESS)
    calls: dict[tuple[str, int], Callable[[], Any]] = {}
    for count in run.settings.timed_spp:

        def path(spp: int = count) -> Any:
            return mi.render(setup.scene, sensor=setup.timing_sensor, integrator=setup.direct, spp=spp)

        samples, seed = dr.opaque(mi.UInt32, count), dr.opaque(mi.UInt32, 1)

        def plain(points: Points, samples: Any = samples, seed: Any = seed) -> Any:
            return mc.monte_carlo(points, material, setup.emitter, samples, seed)

        calls["path", count] = path
        calls["monte_carlo", count] = methods.with_primary_rays(setup, plain)
    return calls
