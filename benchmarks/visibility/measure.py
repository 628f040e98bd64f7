"""The experiment: the specular picture by each rule of visibility, against the path tracer at two depths."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, report, timing
from benchmarks.common import montecarlo as mc
from benchmarks.visibility.budget import budgets
from benchmarks.visibility.payoff import payoffs
from benchmarks.visibility.rules import Rule, rules
from benchmarks.visibility.scenes import make_scene
from benchmarks.visibility.settings import Settings
from benchmarks.visibility.stage import TIMED_ROUGHNESS, Stage

DEPTHS = {"direct": 2, "bounce": 3, "full": 12}
"""Mitsuba's `max_depth`: light after one reflection, after up to two, and after up to eleven."""


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Run it all; what comes back is the JSON report."""
    begin = time.perf_counter()
    scenes = [make_scene(name, settings.detail) for name in (*settings.scenes, *settings.meshes)]
    rows: list[dict[str, Any]] = []
    curve: list[dict[str, Any]] = []
    taken_apart: list[dict[str, Any]] = []
    facts: dict[str, Any] = {}
    for concave in tqdm(scenes, desc="scenes", disable=quiet):
        stage = Stage(concave, settings)
        found: list[dict[str, Any]] = []
        for roughness in tqdm(settings.roughness, desc=stage.name, disable=quiet):
            stage.material(roughness)
            references = {name: stage.reference(depth) for name, depth in DEPTHS.items()}
            found += _errors(stage, roughness, references)
            curve += _curve(stage, roughness)
            taken_apart += budgets(stage, roughness, references, DEPTHS["full"])
        times = _times(stage)
        rows += [row | times.get(row["method"], dict.fromkeys(("ms", "frame_ms"))) for row in found]
        facts[stage.name] = {
            "pixels": stage.points.count,
            "triangles": len(concave.mesh.faces),
            "surfels": stage.surfels.count,
        }
    return {
        "machine": report.machine(),
        "settings": vars(settings),
        "seconds": time.perf_counter() - begin,
        "scenes": facts,
        "rows": rows,
        "curve": curve,
        "budgets": taken_apart,
        "payoffs": payoffs(rows, taken_apart),
    }


def _errors(stage: Stage, roughness: float, references: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A row for each rule and depth."""
    pictures = {rule: stage.picture(rule) for rule in rules(stage.settings)}
    rows = []
    for name, batches in references.items():
        reference = mc.estimate(batches)
        for rule, values in pictures.items():
            found = errors.compare(values, reference)
            rows.append(
                {
                    "scene": stage.name,
                    "roughness": roughness,
                    "method": rule.name,
                    **vars(rule),
                    "depth": name,
                    "bias": found.bias,
                    "bias_floor": found.bias_floor,
                    "relmse": found.relmse,
                    "relmse_floor": found.relmse_floor,
                    "below_floor": found.below_floor,
                }
            )
    return rows


def _curve(stage: Stage, roughness: float) -> list[dict[str, Any]]:
    """Over rays: distance of the visibility to the exact one, and of the picture to that of many rays."""
    exact, noise = stage.visibility()
    limit = stage.picture(Rule(stage.settings.limit, bounces=1))
    weight = errors.weight(limit)
    found = []
    for rays in (*stage.settings.counts, stage.settings.limit):
        visibility = np.array(stage.seen(stage.points, Rule(rays)).visibility, np.float64)
        picture = stage.picture(Rule(rays, bounces=1))
        found.append(
            {
                "scene": stage.name,
                "roughness": roughness,
                "rays": rays,
                "visibility_rms": float(np.sqrt(np.mean((visibility - exact) ** 2))),
                "visibility_floor": float(np.sqrt(np.mean(noise**2))),
                "visibility_bias": float(np.mean(visibility - exact)),
                "to_limit": float(np.mean((picture - limit) ** 2 * weight)),
            }
        )
    return found


def _times(stage: Stage) -> dict[str, dict[str, float]]:
    """Milliseconds of each rule that is timed, by name: shading alone, and the product's frame."""
    stage.material(TIMED_ROUGHNESS)
    timed = [rule for rule in rules(stage.settings) if rule.rays in (0, 1, *stage.settings.rays)]
    seconds = stage.settings.timing_seconds
    shading, frame = (
        timing.milliseconds({rule.name: make(rule) for rule in timed}, seconds)
        for make in (stage.shading_call, stage.frame_call)
    )
    return {rule.name: {"ms": shading[rule.name], "frame_ms": frame[rule.name]} for rule in timed}
