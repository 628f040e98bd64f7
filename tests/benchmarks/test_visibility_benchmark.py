"""The benchmark of visibility: its scenes, its choice of settings, and numbers ordered as they must be."""

from dataclasses import replace
from typing import Any

import pytest

from benchmarks.common.errors import compare
from benchmarks.common.montecarlo import estimate
from benchmarks.common.report import where
from benchmarks.visibility import cases
from benchmarks.visibility.__main__ import HARMONICS, tradeoffs
from benchmarks.visibility.cases import SMALL, Rule
from benchmarks.visibility.setup import Setup

BENCHMARK = "visibility"
SCENES = ("bowl", "plates")


@pytest.mark.slow
def test_small_instance_is_ordered(result: dict[str, Any]) -> None:
    """More rays and more bounces reduce the error."""
    for scene in SCENES:
        error = {row["method"]: row["relmse"] for row in where(result["rows"], scene=scene)}
        for rule in ("mirror ray", "4 rays", "64 rays"):
            assert error[f"{rule}, 4 bounces"] < error[f"{rule}, 1 bounce"] < 0.85 * error[rule]
        for bounces in ("1 bounce", "4 bounces"):
            few, many = (error[f"{rays} rays, {bounces}"] for rays in (4, 64))
            assert many < few < error[f"mirror ray, {bounces}"]
        assert error["64 rays, 4 bounces"] < 0.25 * error["mirror ray"]
        assert error[HARMONICS] < 0.5 * error["mirror ray"]


def test_bounces_approach_the_path_tracer_at_full_depth() -> None:
    """In a bowl, where most light comes by several reflections: the bias falls to less than 5 %."""
    settings = replace(SMALL, size=24, spp=32)
    setup = Setup(cases.make_scene("bowl", settings.detail), settings)
    setup.material(0.3)
    reference = estimate(setup.reference(12))
    found = [compare(setup.image(Rule(64, bounces)), reference) for bounces in (0, 1, 4, 8)]
    bias, relmse = ([row[key] for row in found] for key in ("bias", "relmse"))
    assert bias == sorted(bias) and bias[0] < -0.3 and abs(bias[-1]) < 0.05
    assert relmse == sorted(relmse, reverse=True) and relmse[-1] < 0.15 * relmse[0]


def test_setting_is_chosen_on_other_scenes_within_budget() -> None:
    """`lucky` is best here, `steady` on the other scene, which decides; `dear` is over the budget."""
    here = {"mirror ray": (1.0, 10.0), "lucky": (0.1, 29.0), "steady": (0.2, 20.0), "dear": (0.01, 31.0)}
    there = {"mirror ray": (1.0, 10.0), "lucky": (0.9, 10.0), "steady": (0.3, 10.0), "dear": (0.01, 10.0)}
    paper = {HARMONICS: (0.4, None)}
    rows: list[dict[str, Any]] = [
        {"scene": scene, "method": name, "relmse": error, "frame_ms": time, "roughness": 0.3}
        for scene, found in (("here", here | paper), ("there", there | paper))
        for name, (error, time) in found.items()
    ]
    found = tradeoffs(rows)[0]
    assert (found["scene"], found["method"]) == ("here", "steady")
    assert found["gain"] == pytest.approx(2) and found["price"] == pytest.approx(2)
    assert found["best_gain"] == pytest.approx(4) and found["mirror_relmse"] == 1
