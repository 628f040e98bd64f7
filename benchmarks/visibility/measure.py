"""Measure the specular image by each rule of visibility against the path tracer at two depths."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, timing
from benchmarks.common import montecarlo as mc
from benchmarks.common.report import Row, where
from benchmarks.visibility.cases import PAPER, Rule, Settings, make_scene, rules
from benchmarks.visibility.harmonics import mirror_radiance
from benchmarks.visibility.setup import TIMED_ROUGHNESS, Setup

DEPTHS = {"direct": 2, "full": 12}
"""Mitsuba's `max_depth`: light after one reflection, and after up to eleven."""
MIRROR = PAPER.name
"""One mirror ray for the whole lobe and no indirect light: what the price is a multiple of."""
HARMONICS = "mirror ray, spherical harmonics"
"""The paper's rule: one mirror ray, indirect light by the best spherical harmonics."""
BUDGET = 3.0
"""Times of the mirror ray alone that a setting may take."""


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Measure every scene; returns the JSON report."""
    scenes = [make_scene(name, settings.detail) for name in (*settings.scenes, *settings.meshes)]
    rows: list[Row] = []
    curve: list[Row] = []
    facts: dict[str, Any] = {}
    for concave in tqdm(scenes, desc="scenes", disable=quiet):
        setup = Setup(concave, settings)
        found: list[Row] = []
        for roughness in tqdm(settings.roughness, desc=setup.name, disable=quiet):
            setup.material(roughness)
            found += _errors(setup, roughness)
            curve += _curve(setup, roughness)
        times = _times(setup)
        rows += [row | {"frame_ms": times.get(row["method"])} for row in found]
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
        "tradeoffs": tradeoffs(rows),
    }


def _errors(setup: Setup, roughness: float) -> list[Row]:
    """Return a row per rule and depth."""
    images = {rule.name: (rule, setup.image(rule)) for rule in rules(setup.settings)}
    images[HARMONICS] = PAPER, setup.image(PAPER, mirror_radiance(setup, DEPTHS["full"]))
    found = []
    for depth, most in DEPTHS.items():
        reference = mc.estimate(setup.reference(most))
        for name, (rule, values) in images.items():
            case = {"scene": setup.name, "roughness": roughness, "method": name, "depth": depth}
            found.append(case | vars(rule) | errors.compare(values, reference))
    return found


def _curve(setup: Setup, roughness: float) -> list[Row]:
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


def _times(setup: Setup) -> dict[str, float]:
    """Return milliseconds of the product's frame for each rule that is timed, by name."""
    setup.material(TIMED_ROUGHNESS)
    timed = [rule for rule in rules(setup.settings) if rule.rays in (0, 1, *setup.settings.rays)]
    limits = setup.settings.timing_seconds, setup.settings.timing_rounds
    return timing.milliseconds({rule.name: setup.frame_call(rule) for rule in timed}, *limits)


def tradeoffs(rows: list[Row]) -> list[Row]:
    """For each scene and roughness: a setting within the budget, and what it gains.

    The setting is chosen on the other scenes: of those within the budget here, the one of the least mean
    logarithm of relMSE there, over all roughness. With one scene only, it is chosen on that scene. Errors are
    those against the path tracer at full depth; `gain` is the ratio of relMSE of the paper's rule and of the
    setting, `best_gain` that of the best setting in hindsight, `price` the ratio of times.
    """
    found = []
    names = list(dict.fromkeys(row["scene"] for row in rows))
    for scene, roughness in dict.fromkeys((row["scene"], row["roughness"]) for row in rows):
        full = where(rows, scene=scene, roughness=roughness, depth="full")
        (mirror,), (paper,) = where(full, method=MIRROR), where(full, method=HARMONICS)
        elsewhere = where(rows, scene=[name for name in names if name != scene] or names, depth="full")
        most = BUDGET * mirror["frame_ms"]
        affordable = [row for row in full if row["frame_ms"] is not None and row["frame_ms"] <= most]
        chosen = min(affordable, key=lambda row: _mean_log(where(elsewhere, method=row["method"])))
        found.append(
            {
                "scene": scene,
                "roughness": roughness,
                "method": chosen["method"],
                "gain": paper["relmse"] / chosen["relmse"],
                "best_gain": paper["relmse"] / min(row["relmse"] for row in affordable),
                "price": chosen["frame_ms"] / mirror["frame_ms"],
                "mirror_relmse": mirror["relmse"],
                "paper_relmse": paper["relmse"],
                "relmse": chosen["relmse"],
            }
        )
    return found


def _mean_log(rows: list[Row]) -> float:
    # The floor keeps an exact setting finite.
    return float(np.mean([np.log(max(row["relmse"], 1e-12)) for row in rows]))
