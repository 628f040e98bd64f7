"""Measure errors and times of every method in one run, on the same pixels, and speed-ups at equal error."""

from __future__ import annotations

import functools
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
from benchmarks.common.view import Light, make_light, rows as image_values, view_bins
from benchmarks.splitsum import budget
from benchmarks.splitsum.setup import CONVEX, Exact, Settings, split_sum

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
        spp = error_times_samples(paths) / max(row["relmse"], CLEAR * row["relmse_floor"])
        path_ms = line(times[row["shape"], row["light"], "path"])(max(spp, 1))
        split_ms = times[row["shape"], row["light"], METHOD][row["setting"]]
        gain = {"path_spp": spp, "speed_up": path_ms / split_ms, "path_exponent": exponent(paths)}
        found.append(case | {"lower_bound": row["below_floor"]} | gain)
    return found


TIMED = (0.5, 0.3)  # metallic and roughness on which times are taken; a kernel is the same for every other
Calls = dict[tuple[str, int], Callable[[], Any]]  # what makes the timed image, by method and setting


@dataclass
class Run:
    """What a run collects; all but `times` goes to JSON as it is."""

    settings: Settings
    rows: list[dict[str, Any]] = field(default_factory=list)
    times: Times = field(default_factory=dict)
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
        """Book the errors of an image (P, 3), for the finest split sum also by view angle."""
        reference = setup.integrals(roughness).radiance(metallic)
        points = setup.points
        case = setup.case(roughness, metallic) | {"method": method, "setting": setting}
        masks: dict[str, Any] = {"all": None}
        if (method, setting) == (METHOD, self.settings.heights[-1]):
            masks |= view_bins(points.n_dot_v())
        for name, mask in masks.items():
            self.rows.append(case | {"n_dot_v": name} | errors.compare(values, reference, mask))


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Measure every case; returns the JSON report."""
    lights = [make_light(name, settings.truth_height) for name in settings.lights]
    run, budgets = Run(settings), []
    materials = [(r, m) for r in settings.roughness for m in settings.metallic]
    stages = [Exact(name, light, settings) for name in settings.shapes for light in lights]
    for setup in tqdm(stages, desc="references, path tracer", disable=quiet):
        for roughness, metallic in materials:
            _traced(run, setup, roughness, metallic)
    filtered = _prefilter(settings, lights)
    for setup in tqdm(stages, desc="split sum, times", disable=quiet):
        run.time(setup, _split_sums(run, setup, filtered, materials) | _traced_calls(setup))
    shared = {(setup.name, setup.light.name): setup for setup in stages}
    for name in tqdm(settings.budget_shapes, desc="error budget", disable=quiet):
        for light in lights:
            budgets += budget.budgets(shared.get((name, light.name)) or Exact(name, light, settings))
    return {
        "settings": vars(settings),
        "frequencies": {light.name: light.frequency() for light in lights},
        "rows": [row | {"ms_per_mpx": time_of(run.times, row)} for row in run.rows],
        "scores": run.scores,
        "speed_ups": speed_ups(run.rows, run.times),
        "budgets": budgets,
    }


# ---------------- the path tracer, stopped after direct light ----------------


def _traced(run: Run, setup: Exact, roughness: float, metallic: float) -> None:
    """Book the path tracer's images."""
    settings, seed = run.settings, 1 + len(run.rows)
    setup.set_material(metallic, roughness)
    for spp in settings.spp:
        values = setup.render(path_tracer(2), spp, seed + spp)
        run.add(setup, "path", spp, roughness, metallic, values)
    score = errors.mean_score(values, setup.integrals(roughness).radiance(metallic))
    run.scores.append(setup.case(roughness, metallic) | {"score": score})


def _traced_calls(setup: Exact) -> Calls:
    """Return the calls that make the path tracer's timed images."""
    setup.set_material(*TIMED)
    render = functools.partial(mi.render, setup.scene, sensor=setup.timing_sensor)
    counts = setup.settings.timed_spp
    return {("path", spp): functools.partial(render, integrator=path_tracer(2), spp=spp) for spp in counts}


# ---------------- split sums ----------------


def _prefilter(settings: Settings, lights: list[Light]) -> dict[tuple[str, int], Any]:
    """Return every light at every height, by (light, height)."""
    filtered = {}
    # One height after the other: only a few operators are kept at a time.
    for height in settings.heights:
        for light in lights:
            filtered[light.name, height] = light.environment(height).prefilter()
    dr.eval([light.levels for light in filtered.values()])
    return filtered


def _split_sums(
    run: Run, setup: Exact, filtered: dict[tuple[str, int], Any], materials: list[tuple[float, float]]
) -> Calls:
    """Book images of the split sums of a setup; returns the calls that make the timed ones."""
    calls: Calls = {}
    heights = setup.settings.heights
    for height, option in [*((height, "") for height in heights), (heights[-1], "dominant")]:
        light, method = filtered[setup.light.name, height], "_".join(filter(None, (METHOD, option)))
        for roughness, metallic in materials:
            radiance = split_sum(setup.points, setup.set_material(metallic, roughness), light, option)
            run.add(setup, method, height, roughness, metallic, image_values(radiance))
        shader = functools.partial(split_sum, material=setup.set_material(*TIMED), light=light, option=option)
        calls[method, height] = setup.with_primary_rays(shader)
    return calls
