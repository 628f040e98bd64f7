"""Measure errors and times of every method in one run, on the same pixels, and speed-ups at equal error."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, timing
from benchmarks.common.errors import CLEAR
from benchmarks.common.report import Row, where
from benchmarks.common.setup import path_tracer
from benchmarks.common.view import Light, make_light, view_bins
from benchmarks.common.view import rows as image_values
from benchmarks.splitsum import budget
from benchmarks.splitsum.setup import CONVEX, LEVEL_SETS, OPTIONS, SHIPPED, Exact, Settings, split_sum

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


def error_times_samples(points: list[tuple[int, float, float]]) -> float:
    """c of relMSE = c / samples through (samples, relMSE, floor), floors taken off; a mean of logarithms."""
    clear = [(n, e - floor) for n, e, floor in points if e > CLEAR * floor]
    chosen = clear or [(n, e) for n, e, _ in points]
    return float(np.exp(np.mean([np.log(n * e) for n, e in chosen])))


def exponent(points: list[tuple[int, float, float]]) -> float | None:
    """Slope of log relMSE over log samples, floors taken off: -1 for independent samples."""
    clear = [(n, e - floor) for n, e, floor in points if e > CLEAR * floor]
    if len(clear) < 2:
        return None
    x, y = np.log(np.array(clear)).T
    return float(np.polyfit(x, y, 1)[0])


def speed_ups(rows: list[Row], times: Times) -> list[dict[str, Any]]:
    """One record for each convex shape, light, material and height: samples, and the ratio of times.

    Where the split sum's error is below the noise floor the ratio is a lower bound, taken at the floor. The
    path tracer cannot take less than one sample.
    """
    found = []
    for row in where(rows, method=METHOD, n_dot_v="all", shape=CONVEX):
        case = {key: row[key] for key in CASE}
        paths = [
            (path["setting"], path["relmse"], path["relmse_floor"])
            for path in where(rows, method="path", **case)
        ]
        spp = error_times_samples(paths) / max(row["relmse"], CLEAR * row["relmse_floor"])
        path_ms = line(times[row["shape"], row["light"], "path"])(max(spp, 1))
        split_ms = times[row["shape"], row["light"], METHOD][row["setting"]]
        found.append(
            case
            | {
                "height": row["setting"],
                "lower_bound": row["below_floor"],
                "path_spp": spp,
                "speed_up": path_ms / split_ms,
                "path_exponent": exponent(paths),
            }
        )
    return found


LEVELS_HEIGHT = 128
"""Rows of the light for other sets of levels: enough that its resolution does not hide them."""
TIMED = (0.5, 0.3)
"""Metallic and roughness on which times are taken; a kernel is the same for every other."""
Calls = dict[tuple[str, int], Callable[[], Any]]
"""What makes the timed image, by method and setting."""


@dataclass
class Run:
    """What a run collects; all but `times` goes to JSON as it is."""

    settings: Settings
    rows: list[dict[str, Any]] = field(default_factory=list)
    times: Times = field(default_factory=dict)
    prefilter_ms: list[dict[str, Any]] = field(default_factory=list)
    scores: list[dict[str, Any]] = field(default_factory=list)

    def time(self, setup: Exact, calls: Calls) -> None:
        """Book the times of calls."""
        megapixels = self.settings.timing_size**2 / 1e6
        limits = self.settings.timing_seconds, self.settings.timing_rounds
        for (method, setting), ms in timing.milliseconds(calls, *limits).items():
            found = self.times.setdefault((setup.name, setup.light.name, method), {})
            found[setting] = ms / megapixels

    def add(
        self, setup: Exact, method: str, setting: int, roughness: float, metallic: float, values: np.ndarray
    ) -> None:
        """Book the errors of an image (P, 3), for the split sum also by view angle."""
        reference = setup.integrals(roughness).radiance(metallic)
        points = setup.points
        case = setup.case(roughness, metallic) | {"method": method, "setting": setting}
        masks: dict[str, Any] = {"all": None}
        if method.startswith("split_sum"):
            masks |= view_bins(points.n_dot_v())
        for name, mask in masks.items():
            self.rows.append(case | {"n_dot_v": name} | errors.compare(values, reference, mask))


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Run it all; what comes back is the JSON report."""
    lights = [make_light(name, settings.truth_height) for name in settings.lights]
    run, budgets, surfel_budgets = Run(settings), [], []
    materials = [(r, m) for r in settings.roughness for m in settings.metallic]
    stages = [Exact(name, light, settings) for name in settings.shapes for light in lights]

    for setup in tqdm(stages, desc="references, path tracer, Monte Carlo", disable=quiet):
        for roughness, metallic in materials:
            _sampled(run, setup, roughness, metallic)
    for levels in (SHIPPED, *settings.level_sets):
        variants = [variant for variant in _variants(settings) if variant.levels == levels]
        filtered = _prefilter(run, lights, variants)
        for setup in tqdm(stages, desc=f"split sum, times ({levels})", disable=quiet):
            calls = _split_sums(run, setup, variants, filtered, materials)
            run.time(setup, calls | (_sampled_calls(setup) if levels == SHIPPED else {}))
    shared = {(setup.name, setup.light.name): setup for setup in stages}
    for name in tqdm(settings.budget_shapes, desc="error budget", disable=quiet):
        for light in lights:
            setup = shared.get((name, light.name)) or Exact(name, light, settings)
            budgets += budget.budgets(setup)
            if name == budget.SHAPE:
                surfel_budgets.append(budget.surfel_budget(setup))
    return {
        "settings": vars(settings),
        "frequencies": {light.name: light.frequency() for light in lights},
        "pixels": {setup.name: setup.points.count for setup in stages},
        "rows": [row | {"ms_per_mpx": time_of(run.times, row)} for row in run.rows],
        "prefilter_ms": run.prefilter_ms,
        "scores": run.scores,
        "speed_ups": speed_ups(run.rows, run.times),
        "budgets": budgets,
        "surfel_budgets": surfel_budgets,
    }


# ---------------- Mitsuba's integrators ----------------


def _samplers() -> dict[str, Any]:
    """The path tracer stopped after direct light, and a renderer that samples the reflectance alone."""
    plain = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}
    return {"path": path_tracer(2), "monte_carlo": mi.load_dict(plain)}


def _sampled(run: Run, setup: Exact, roughness: float, metallic: float) -> None:
    """Images of the path tracer and of plain Monte Carlo."""
    settings, seed = run.settings, 1 + len(run.rows)
    setup.set_material(metallic, roughness)
    counts = {"path": settings.spp, "monte_carlo": settings.samples}
    if metallic != settings.metallic[len(settings.metallic) // 2]:
        del counts["monte_carlo"]  # only for the plots of speed against error, which show one metal
    samplers = _samplers()
    for method, spp in [(name, n) for name, found in counts.items() for n in found]:
        values = setup.render(samplers[method], spp, seed + spp)
        run.add(setup, method, spp, roughness, metallic, values)
        if (method, spp) == ("path", settings.spp[-1]):
            score = errors.mean_score(values, setup.integrals(roughness).radiance(metallic))
            run.scores.append(setup.case(roughness, metallic) | {"score": score})


def _sampled_calls(setup: Exact) -> Calls:
    """Calls that make the timed images of both."""
    setup.set_material(*TIMED)
    render = functools.partial(mi.render, setup.scene, sensor=setup.timing_sensor)
    return {
        (method, spp): functools.partial(render, integrator=integrator, spp=spp)
        for method, integrator in _samplers().items()
        for spp in setup.settings.timed_spp
    }


# ---------------- split sums ----------------


@dataclass(frozen=True)
class Variant:
    """A split sum: levels, rows of the light, and an option of `shade`."""

    levels: str
    height: int
    option: str = ""

    @property
    def method(self) -> str:
        """Its name in the report."""
        levels = "" if self.levels == SHIPPED else f"_{self.levels}_levels"
        return f"split_sum{levels}" + (f"_{self.option}" if self.option else "")


def _variants(settings: Settings) -> list[Variant]:
    shipped = [Variant(SHIPPED, height) for height in settings.heights]
    heights = {settings.height, settings.heights[-1]}
    options = [Variant(SHIPPED, *pair) for pair in itertools.product(heights, filter(None, OPTIONS))]
    levels = [Variant(name, min(LEVELS_HEIGHT, settings.heights[-1])) for name in settings.level_sets]
    return sorted(shipped + options, key=lambda variant: variant.height) + levels


def _prefilter(run: Run, lights: list[Light], variants: list[Variant]) -> dict[tuple[str, int], Any]:
    """Every light at every height, by (light, height), with one set of levels; books the time it takes."""
    filtered = {}
    # One height after the other: only a few operators are kept at a time.
    for variant in (variant for variant in variants if not variant.option):
        levels = LEVEL_SETS[variant.levels]
        environments = [light.environment(variant.height) for light in lights]
        for light, environment in zip(lights, environments, strict=True):
            filtered[light.name, variant.height] = environment.prefilter(levels)

        def again(environment: Any = environments[0], levels: Any = levels) -> Any:
            return environment.prefilter(levels).levels

        ms = timing.milliseconds({0: again}, run.settings.timing_seconds)[0]
        run.prefilter_ms.append({"method": variant.method, "height": variant.height, "ms": ms})
    dr.eval([light.levels for light in filtered.values()])
    return filtered


def _split_sums(
    run: Run,
    setup: Exact,
    variants: list[Variant],
    filtered: dict[tuple[str, int], Any],
    materials: list[tuple[float, float]],
) -> Calls:
    """Book images of the split sums of a setup; calls that make the timed ones."""
    calls: Calls = {}
    for variant in variants:
        light, option = filtered[setup.light.name, variant.height], variant.option
        for roughness, metallic in materials:
            radiance = split_sum(setup.points, setup.set_material(metallic, roughness), light, option)
            run.add(setup, variant.method, variant.height, roughness, metallic, image_values(radiance))
        shader = functools.partial(split_sum, material=setup.set_material(*TIMED), light=light, option=option)
        calls[variant.method, variant.height] = setup.with_primary_rays(shader)
    return calls
