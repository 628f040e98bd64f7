"""The benchmark of the split sum runs, and its numbers are ordered as they must be. No times are tested."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from benchmarks.common import errors
from benchmarks.common import montecarlo as mc
from benchmarks.common import view as common
from benchmarks.common.errors import Step
from benchmarks.common.report import where
from benchmarks.splitsum import budget, measure, setup
from mi_refgs.errors import InputError
from mi_refgs.reference.light import lobe_average
from mi_refgs.reference.lobe import split_sum_entry
from mi_refgs.shade.light import lobe_matrices

BENCHMARK = "splitsum"
Row = dict[str, Any]


def cases(
    result: dict[str, Any], method: str, view_bin: str = "all"
) -> dict[tuple[Any, ...], dict[int, Row]]:
    """Rows of a method by case, then by setting."""
    found: dict[tuple[Any, ...], dict[int, Row]] = {}
    for row in where(result["rows"], method=method, n_dot_v=view_bin):
        key = (row["shape"], row["light"], row["roughness"], row["metallic"])
        found.setdefault(key, {})[row["setting"]] = row
    return found


# ---------- The small instance ----------


def test_reports_are_written(folder: Path, result: dict[str, Any]) -> None:
    page = (folder / "splitsum.md").read_text()
    assert not re.search(r"\bnan\b|\binf\b", page)
    for name in ("pareto", "lights", "trust", "speedup", "budget"):
        assert f"](images/splitsum_{name}.png)" in page
        assert (folder / "images" / f"splitsum_{name}.png").stat().st_size > 10_000
    assert all(row["relmse"] >= 0 and row["mape"] >= 0 for row in result["rows"])
    split = cases(result, "split_sum")
    settings = result["settings"]
    assert len(split) == math.prod(len(settings[k]) for k in ("shapes", "lights", "roughness", "metallic"))
    assert all(set(by) == set(settings["heights"]) for by in split.values())


def test_path_tracer_agrees_with_reference(result: dict[str, Any]) -> None:
    """Mean errors in standard errors: within 4 each, and with a spread of about 1."""
    scores = np.array([row["score"] for row in result["scores"]])
    assert np.abs(scores).max() < 4
    assert 0.5 < scores.std() < 1.6


def test_more_samples_are_better(result: dict[str, Any]) -> None:
    """Path tracer: as 1/samples. Plain Monte Carlo: where it does not miss the sun."""
    for key, by in cases(result, "path").items():
        values = [by[n]["relmse"] for n in sorted(by)]
        assert values == sorted(values, reverse=True), key
    slopes = [row["path_exponent"] for row in result["speed_ups"]]
    assert -1.2 < min(slopes) and max(slopes) < -0.8
    for key, by in cases(result, "monte_carlo").items():
        if key[1] != "sunsky":
            values = [by[n]["relmse"] for n in sorted(by)]
            assert values == sorted(values, reverse=True), key


def test_more_rows_are_not_worse(result: dict[str, Any]) -> None:
    """They help where details show; elsewhere other errors are left, and may grow by a quarter at most.

    But for the sun's glint on a floor: the lobe is wrong there by more than what it should show; and where
    a relMSE below 1e-5 is left, 0.3 %, of which few rows can cancel a part.
    """
    for key, by in cases(result, "split_sum").items():
        values = [by[height]["relmse"] for height in sorted(by)]
        floor = 2 * max(row["relmse_floor"] for row in by.values())
        if key[1] == "checker" and key[2] == 0.1:
            assert values == sorted(values, reverse=True), key
        if key[:2] != ("patch", "sunsky"):
            assert values[-1] < max(1.25 * values[0] + floor, 1e-5), key


def test_constant_light_has_no_error(result: dict[str, Any]) -> None:
    """The table is exact for it: only its own interpolation is left, 5e-4 of the radiance."""
    for key, by in cases(result, "split_sum").items():
        if key[1] == "constant":
            assert all(row["relmse"] < 2.5e-7 + 2 * row["relmse_floor"] for row in by.values()), key


def test_grazing_errors_grow_with_the_frequency_of_the_light(result: dict[str, Any]) -> None:
    """Sphere, n·v < 0.1, median over materials."""
    order = sorted(result["frequencies"], key=lambda name: float(result["frequencies"][name]))
    assert order == ["constant", "gradient", "checker", "sunsky"]
    finest = max(result["settings"]["heights"])
    grazing = {
        light: np.median(
            [
                by[finest]["relmse"]
                for key, by in cases(result, "split_sum", "0-0.1").items()
                if key[:2] == ("sphere", light)
            ]
        )
        for light in order
    }
    assert grazing["constant"] < grazing["gradient"] < grazing["checker"] < grazing["sunsky"], grazing


def test_grazing_is_worse_than_facing(result: dict[str, Any]) -> None:
    """On the sphere under a smooth light: by more than twice in relMSE at every roughness."""
    finest = max(result["settings"]["heights"])
    grazing, facing = (cases(result, "split_sum", name) for name in ("0.1-0.2", "0.5-1"))
    for key, by in grazing.items():
        if key[0] == "sphere" and key[1] == "gradient":
            assert by[finest]["relmse"] > 2 * facing[key][finest]["relmse"], key


def test_fewer_levels_are_not_better(result: dict[str, Any]) -> None:
    """Over all cases together."""
    shipped, few = cases(result, "split_sum"), cases(result, "split_sum_few_levels")
    ratios = [
        row["relmse"] / shipped[key][height]["relmse"]
        for key, by in few.items()
        for height, row in by.items()
        if not shipped[key][height]["below_floor"]
    ]
    assert np.mean(np.log(ratios)) > 0


def test_budgets_name_the_largest_part(result: dict[str, Any]) -> None:
    """Only the torus has shadows; the table is never what errs."""
    for row in result["budgets"]:
        parts = {part["name"]: part for part in row["parts"]}
        assert (budget.SHADOW in parts) == (row["shape"] == "torus")
        assert parts[budget.TABLE]["relmse"] < 1e-6
    sphere = where(result["budgets"], shape="sphere", light="checker", roughness=0.1, height=32)
    for row in sphere:
        assert max(row["parts"], key=lambda part: float(part["relmse"]))["name"] == budget.RESOLUTION
    rough = where(result["budgets"], shape="sphere", light="gradient", roughness=0.8)
    for row in rough:
        assert max(row["parts"], key=lambda part: float(part["relmse"]))["name"] == budget.LOBE


def test_surfels_cost_something(result: dict[str, Any]) -> None:
    """One budget a light; under a constant one the split sum is exact and the rest is the surfels' own."""
    found = {row["light"]: row for row in result["surfel_budgets"]}
    assert set(found) == set(result["frequencies"])
    for row in found.values():
        assert row["covered"] > 0.9
    parts = {part["name"]: part["relmse"] for part in found["constant"]["parts"]}
    assert parts[budget.SPLIT_SUM] < 1e-5 < parts[budget.BLENDING] < 1e-2


# ---------- Its parts, against what they stand for ----------


def sphere(size: int = 16) -> tuple[Any, common.Points]:
    """A sphere under a gradient, and its points."""
    light = common.make_light("gradient", 32)
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "light": light.emitter()})
    look = common.Look((0, 0.6, 4), (0, 0, 0), 30)
    return scene, common.surface(scene, common.make_sensor(look, size), size)


def test_samples_go_through_pixel_centres() -> None:
    """However many samples, Mitsuba's depth of a sphere is that of the central rays, to float32."""
    size = 16
    scene, points = sphere(size)
    sensor = common.make_sensor(common.Look((0, 0.6, 4), (0, 0, 0), 30), size)
    depth = mi.load_dict({"type": "aov", "aovs": "p:position", "path": {"type": "direct"}})
    image = np.array(mi.render(scene, sensor=sensor, integrator=depth, spp=16))[..., -3:]
    position = np.array(points.position).T
    assert points.count > 100
    np.testing.assert_allclose(points.of_image(image), position, atol=2e-6)


@pytest.mark.parametrize("roughness", [0.1, 0.5, 1.0])
def test_integrals_of_a_constant_light_are_the_table(roughness: float) -> None:
    """∫ (1 - Fc) f cosθ and ∫ Fc f cosθ against float64 quadrature, and their noise says how far."""
    light = common.make_light("constant", 16)
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}, "light": light.emitter()})
    look = common.Look((0, 0.6, 4), (0, 0, 0), 30)
    points = common.surface(scene, common.make_sensor(look, 8), 8)
    α = dr.opaque(mi.Float, roughness**2)
    found = mc.integrate(lambda p: mc.brdf_lobe(p, α), points, scene.environment(), samples=1597)
    wanted = np.array([split_sum_entry(float(c), roughness) for c in points.n_dot_v()])
    for k, batches in enumerate(found):
        estimate = mc.estimate(batches)
        error = np.abs(estimate.mean[:, 0] - wanted[:, k])
        assert (error < 6 * estimate.error[:, 0] + 1e-4).all()
        assert error.max() < 2e-3
    a, b = mc.exact_table(points.n_dot_v(), roughness)
    np.testing.assert_allclose(np.concatenate([a, b], axis=1), wanted, atol=3e-5)


@pytest.mark.parametrize("roughness", [0.15, 0.6, 1.0])
def test_lobe_average_is_the_reference_one(roughness: float) -> None:
    scene, points = sphere(6)
    α = dr.opaque(mi.Float, roughness**2)
    environment = scene.environment()
    estimate = mc.estimate(
        mc.integrate(lambda p: mc.prefilter_lobe(p, roughness, α), points, environment, samples=987)[0]
    )
    normal, towards = (np.array(v, np.float64).T for v in (points.normal, points.view))
    mirror = 2 * np.sum(normal * towards, -1, keepdims=True) * normal - towards
    radiance = common.make_light("gradient", 32).radiance.astype(np.float64)
    for k in range(0, points.count, 5):
        wanted = lobe_average(radiance, mirror[k], roughness, rings=200, spokes=200)
        assert (np.abs(estimate.mean[k] - wanted) < 6 * estimate.error[k] + 2e-3 * wanted).all()


def test_standard_error_matches_scatter() -> None:
    """Two independent estimates differ by as much as they say: root mean square of the scores near 1."""
    scene, points = sphere(24)
    α = dr.opaque(mi.Float, 0.25)
    first, second = (
        mc.estimate(
            mc.integrate(
                lambda p: mc.brdf_lobe(p, α), points, scene.environment(), samples=89, batches=16, seed=seed
            )[0]
        )
        for seed in (1, 2)
    )
    score = (first.mean - second.mean) / np.hypot(first.error, second.error)
    assert 0.8 < np.sqrt((score**2).mean()) < 1.25


def test_lights_have_a_mean_of_one_and_rise_in_frequency() -> None:
    made = [common.make_light(name, 64) for name in common.BUILT_IN]
    for light in made:
        assert light.radiance.shape == (64, 128, 3)
        mean = np.average(light.radiance.mean((1, 2)), weights=lobe_matrices.row_areas(64))
        assert mean == pytest.approx(1, rel=2e-3)
    sky = made[-1].radiance.mean(-1)
    row, column = np.unravel_index(sky.argmax(), sky.shape)
    elevation = 90 - np.degrees(lobe_matrices.row_angles(64)[row])
    azimuth = np.degrees(lobe_matrices.column_angles(128)[column])
    assert elevation == pytest.approx(common.SUN_ELEVATION, abs=3)
    assert azimuth == pytest.approx(common.SUN_AZIMUTH % 360, abs=3)
    assert made[0].frequency() == 0 < made[1].frequency() < made[-1].frequency()
    with pytest.raises(InputError, match=r"nowhere\.exr"):
        common.make_light("nowhere.exr", 64)


def test_errors_report_their_noise_floor() -> None:
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.5, 1.5, (4000, 3))
    reference = mc.Estimate(truth + 0.01 * rng.normal(size=truth.shape), np.full(truth.shape, 0.01))
    same = errors.compare(truth, reference)
    assert same["below_floor"] and same["relmse"] == pytest.approx(same["relmse_floor"], rel=0.1)
    assert abs(same["bias"]) < 4 * same["bias_floor"]
    off = errors.compare(1.05 * truth, reference)
    assert not off["below_floor"] and off["bias"] == pytest.approx(0.05, abs=1e-3)
    assert off["relmse"] == pytest.approx(0.05**2, rel=0.1) and off["mape"] == pytest.approx(0.05, rel=0.05)


def test_budget_recovers_known_parts() -> None:
    """Two orthogonal errors and two that cancel."""
    exact = np.ones((2, 3))
    a, b = np.array([[0.1], [0.0]]), np.array([[0.0], [0.2]])
    found = errors.decompose([Step("", exact + a + b), Step("a", exact + b), Step("b", exact)])
    assert found["adds_up"] and found["interaction"] == pytest.approx(0, abs=1e-12)
    assert [part["share"] for part in found["parts"]] == pytest.approx([0.2, 0.8])
    assert [part["bias"] for part in found["parts"]] == pytest.approx([0.05, 0.1])
    with np.errstate(all="raise"):
        found = errors.decompose([Step("", exact), Step("a", exact - a), Step("b", exact)])
    assert found["total"] == pytest.approx(0) and not found["adds_up"]
    assert found["correlation"] == pytest.approx(-1)


def test_budget_names_the_interacting_pair() -> None:
    """Three parts, of which the last two cancel at the second of two points: one part, they add up."""
    exact = np.ones((2, 3))
    a, b = np.array([[0.3], [0.0]]), np.array([[0.0], [0.2]])
    found = errors.decompose([Step("", exact + a), Step("a", exact), Step("b", exact - b), Step("c", exact)])
    assert found["pair"] == ["b", "c"] and found["correlation"] == pytest.approx(-1)
    assert not found["adds_up"]
    row = {"floor": 0.0, **found}
    text = errors.interactions([row, {**row, "total": 0.0, "floor": 1.0}])
    assert text.splitlines()[2:] == ["| b and c | 1 | 1 | -1.00 |"]
    cells = errors.budget_table("case", [("known", row), ("noise", {**row, "floor": 1.0})]).splitlines()[2:]
    assert cells[0].startswith("| known | 100 % (") and "b and c, ρ = -1.00" in cells[0]
    assert cells[1] == "| noise | – | – | – | < 1.0 | – | noise |"


def test_equal_error_is_interpolated() -> None:
    """relMSE = 0.8 / spp and 3 + 2 spp milliseconds: a split sum of 0.01 is worth 80 spp, 163 ms."""
    points = [(n, 0.8 / n, 0.0) for n in (1, 4, 16)]
    assert measure.error_times_samples(points) / 0.01 == pytest.approx(80)
    assert measure.exponent(points) == pytest.approx(-1)
    assert measure.line({n: 3 + 2.0 * n for n in (1, 4, 16)})(80) == pytest.approx(163)
    noisy = [(n, 0.8 / n + 0.1, 0.1) for n in (1, 4)]
    assert measure.error_times_samples(noisy) == pytest.approx(0.8)


def test_other_level_sets_are_filtered() -> None:
    """A light with other levels has their texels and mixes by their roughness."""
    light = common.make_light("gradient", 16).environment(16)
    shipped, few = light.prefilter(), light.prefilter(setup.LEVEL_SETS["few"])
    assert len(few.operator.shapes) == 4
    assert len(np.array(few.levels)) < len(np.array(shipped.levels))
    direction = mi.Vector3f(0.6, 0.0, 0.8)
    for roughness in (0.1, 0.32, 1.0):
        a, b = (x.specular(direction, mi.Float(roughness)).numpy() for x in (few, shipped))
        np.testing.assert_allclose(a, b, rtol=1e-5)
    a, b = (x.specular(direction, mi.Float(0.6)).numpy() for x in (few, shipped))
    assert not np.allclose(a, b, rtol=1e-4)
