"""Visibility and indirect light of the specular term in concave scenes, against Mitsuba's path tracer.

    python -m benchmarks.visibility                       every scene, four minutes on 2 cores
    python -m benchmarks.visibility --small -o out        a small instance, below a minute
    python -m benchmarks.visibility --mesh bob.obj -o out your closed mesh beside the built-in scenes

Writes visibility.json; `python -m benchmarks.pages` makes the tables and the plot of docs/visibility.md."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, montecarlo as mc, timing
from benchmarks.common.report import Row, benchmark, where
from benchmarks.visibility.cases import PAGE, PAPER, SMALL, Settings, make_scene, rules
from benchmarks.visibility.harmonics import mirror_radiance
from benchmarks.visibility.setup import TIMED_ROUGHNESS, Setup

DEPTH = 12  # Mitsuba's `max_depth`: light after up to eleven reflections
MIRROR = PAPER.name
"""One mirror ray for the whole lobe and no indirect light: what the price is a multiple of."""
HARMONICS = "mirror ray, spherical harmonics"
"""The paper's rule: one mirror ray, indirect light by the best spherical harmonics."""
BUDGET = 3.0  # times of the mirror ray alone that a setting may take


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Measure every scene; returns the JSON report."""
    scenes = [make_scene(name, settings.detail) for name in (*settings.scenes, *settings.meshes)]
    rows: list[Row] = []
    for concave in tqdm(scenes, desc="scenes", disable=quiet):
        setup = Setup(concave, settings)
        found: list[Row] = []
        for roughness in tqdm(settings.roughness, desc=setup.name, disable=quiet):
            setup.material(roughness)
            found += _errors(setup, roughness)
        times = _times(setup)
        rows += [row | {"frame_ms": times.get(row["method"])} for row in found]
    return {
        "settings": vars(settings) | {"meshes": [Path(name).name for name in settings.meshes]},
        "scenes": [concave.name for concave in scenes],
        "rows": rows,
        "tradeoffs": tradeoffs(rows),
    }


def _errors(setup: Setup, roughness: float) -> list[Row]:
    """Return a row per rule."""
    images = {rule.name: (rule, setup.image(rule)) for rule in rules(setup.settings)}
    images[HARMONICS] = PAPER, setup.image(PAPER, mirror_radiance(setup, DEPTH))
    reference, case = mc.estimate(setup.reference(DEPTH)), {"scene": setup.name, "roughness": roughness}
    return [
        case | {"method": name} | vars(rule) | errors.compare(values, reference)
        for name, (rule, values) in images.items()
    ]


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
    setting, `best_gain` that of the best setting in hindsight, `price` the ratio of times."""
    found = []
    names = list(dict.fromkeys(row["scene"] for row in rows))
    for scene, roughness in dict.fromkeys((row["scene"], row["roughness"]) for row in rows):
        full = where(rows, scene=scene, roughness=roughness)
        (mirror,), (paper,) = where(full, method=MIRROR), where(full, method=HARMONICS)
        elsewhere = where(rows, scene=[name for name in names if name != scene] or names)
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


if __name__ == "__main__":
    sys.exit(benchmark("visibility", __doc__, measure, PAGE, SMALL, ("--mesh", "meshes")))
