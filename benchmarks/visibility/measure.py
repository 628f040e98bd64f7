"""Measure the specular image by each rule of visibility against the path tracer at two depths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, timing
from benchmarks.common import montecarlo as mc
from benchmarks.visibility.budget import budgets
from benchmarks.visibility.cases import Rule, Settings, make_scene, rules
from benchmarks.visibility.page import tradeoffs
from benchmarks.visibility.setup import TIMED_ROUGHNESS, Setup

DEPTHS = {"direct": 2, "bounce": 3, "full": 12}
"""Mitsuba's `max_depth`: light after one reflection, after up to two, and after up to eleven."""


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Run it all; what comes back is the JSON report."""
    scenes = [make_scene(name, settings.detail) for name in (*settings.scenes, *settings.meshes)]
    rows: list[dict[str, Any]] = []
    curve: list[dict[str, Any]] = []
    found_budgets: list[dict[str, Any]] = []
    facts: dict[str, Any] = {}
    for concave in tqdm(scenes, desc="scenes", disable=quiet):
        setup = Setup(concave, settings)
        found: list[dict[str, Any]] = []
        for roughness in tqdm(settings.roughness, desc=setup.name, disable=quiet):
            setup.material(roughness)
            references = {name: setup.reference(depth) for name, depth in DEPTHS.items()}
            found += _errors(setup, roughness, references)
            curve += _curve(setup, roughness)
            found_budgets += budgets(setup, roughness, references, DEPTHS["full"])
        times = _times(setup)
        rows += [row | times.get(row["method"], dict.fromkeys(("ms", "frame_ms"))) for row in found]
        facts[setup.name] = {
            "pixels": setup.points.count,
            "triangles": len(concave.mesh.faces),
            "surfels": setup.surfels.count,
        }
    return {
        "settings": vars(settings) | {"meshes": [Path(name).name for name in settings.meshes]},
        "scenes": facts,
        "rows": rows,
        "curve": curve,
        "budgets": found_budgets,
        "tradeoffs": tradeoffs(rows, found_budgets),
    }


def _errors(setup: Setup, roughness: float, references: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """A row for each rule and depth."""
    images = {rule: setup.image(rule) for rule in rules(setup.settings)}
    rows = []
    for name, batches in references.items():
        reference = mc.estimate(batches)
        for rule, values in images.items():
            case = {"scene": setup.name, "roughness": roughness, "method": rule.name, "depth": name}
            rows.append(case | vars(rule) | errors.compare(values, reference))
    return rows


def _curve(setup: Setup, roughness: float) -> list[dict[str, Any]]:
    """Over rays: distance of the visibility to the exact one, and of the image to that of many rays."""
    exact, noise = setup.visibility()
    limit = setup.image(Rule(setup.settings.limit, bounces=1))
    weight = errors.weight(limit)
    found = []
    for rays in (*setup.settings.counts, setup.settings.limit):
        visibility = np.array(setup.seen(setup.points, Rule(rays)).visibility, np.float64)
        image = setup.image(Rule(rays, bounces=1))
        found.append(
            {
                "scene": setup.name,
                "roughness": roughness,
                "rays": rays,
                "visibility_rms": float(np.sqrt(np.mean((visibility - exact) ** 2))),
                "visibility_floor": float(np.sqrt(np.mean(noise**2))),
                "visibility_bias": float(np.mean(visibility - exact)),
                "to_limit": float(np.mean((image - limit) ** 2 * weight)),
            }
        )
    return found


def _times(setup: Setup) -> dict[str, dict[str, float]]:
    """Milliseconds of each rule that is timed, by name: shading alone, and the product's frame."""
    setup.material(TIMED_ROUGHNESS)
    timed = [rule for rule in rules(setup.settings) if rule.rays in (0, 1, *setup.settings.rays)]
    limits = setup.settings.timing_seconds, setup.settings.timing_rounds
    shading, frame = (
        timing.milliseconds({rule.name: make(rule) for rule in timed}, *limits)
        for make in (setup.shading_call, setup.frame_call)
    )
    return {rule.name: {"ms": shading[rule.name], "frame_ms": frame[rule.name]} for rule in timed}
