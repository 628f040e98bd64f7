"""The benchmark of the split sum: its references, and numbers ordered as they must be; no times."""

from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from benchmarks.common import errors, view as common
from benchmarks.common.errors import Step
from benchmarks.common.report import where

BENCHMARK = "splitsum"
LIGHTS = ("constant", "gradient", "checker", "sunsky")


@pytest.mark.slow
def test_path_tracer_agrees_with_reference(result: dict[str, Any]) -> None:
    """Mean errors in standard errors: within 4 each, with a spread of about 1; relMSE as 1/samples."""
    scores = np.array([row["score"] for row in result["scores"]])
    assert np.abs(scores).max() < 4 and 0.5 < scores.std() < 1.6
    slopes = [row["path_exponent"] for row in result["speed_ups"]]
    assert -1.25 < min(slopes) and max(slopes) < -0.75


@pytest.mark.slow
def test_errors_rise_with_frequency_and_angle(result: dict[str, Any]) -> None:
    """A constant light has only the table's; grazing errors on the sphere grow with the light's detail."""
    assert sorted(result["frequencies"], key=result["frequencies"].get) == list(LIGHTS)
    split = where(result["rows"], method="split_sum", shape="sphere")
    for row in where(split, light="constant"):
        assert row["relmse"] < 2.5e-7 + 2 * row["relmse_floor"]
    grazing = [np.median([r["relmse"] for r in where(split, light=x, n_dot_v="0-0.1")]) for x in LIGHTS]
    assert grazing == sorted(grazing)
    for row in where(split, light="gradient", n_dot_v="0.1-0.2"):
        (facing,) = where(split, light="gradient", n_dot_v="0.5-1", roughness=row["roughness"])
        assert row["relmse"] > 2 * facing["relmse"]
    sharp = where(split, light="checker", n_dot_v="all", roughness=0.1)
    by_rows = [row["relmse"] for row in sorted(sharp, key=lambda row: int(row["setting"]))]
    assert by_rows == sorted(by_rows, reverse=True)


def sphere(size: int = 16, light: str = "gradient") -> tuple[Any, common.Points]:
    """A sphere under a light, and its points."""
    emitter = common.make_light(light, 32).emitter()
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "light": emitter})
    look = common.Look((0, 0.6, 4), (0, 0, 0), 30)
    return scene, common.surface(scene, common.make_sensor(look, size), size)


def test_samples_go_through_pixel_centres() -> None:
    """However many samples, Mitsuba's depth of a sphere is that of the central rays, to float32."""
    scene, points = sphere(16)
    sensor = common.make_sensor(common.Look((0, 0.6, 4), (0, 0, 0), 30), 16)
    depth = mi.load_dict({"type": "aov", "aovs": "p:position", "path": {"type": "direct"}})
    image = np.array(mi.render(scene, sensor=sensor, integrator=depth, spp=16))[..., -3:]
    assert points.count > 100
    np.testing.assert_allclose(points.of_image(image), np.array(points.position).T, atol=2e-6)


def test_budget_recovers_known_parts() -> None:
    """Two orthogonal errors and two that cancel."""
    exact = np.ones((2, 3))
    a, b = np.array([[0.1], [0.0]]), np.array([[0.0], [0.2]])
    found = errors.decompose([Step("", exact + a + b), Step("a", exact + b), Step("b", exact)])
    assert [part["share"] for part in found["parts"]] == pytest.approx([0.2, 0.8])
    with np.errstate(all="raise"):
        found = errors.decompose([Step("", exact), Step("a", exact - a), Step("b", exact)])
    assert found["total"] == pytest.approx(0)
