"""Shading: terms and every derivative against the float64 reference, energy, and degenerate points."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.reference import shade as reference
from mi_refgs.shade import brdf
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.split_sum import shade
from tests.helpers import check_slopes, level_maps, unit, vector
from tests.scenes.shading_points import N, exact_terms, points_of, shading_values

OPTIONS = (
    ShadingOptions(),
    ShadingOptions(diffuse="irradiance"),
    ShadingOptions(diffuse="irradiance", dominant=True),
    ShadingOptions(diffuse="irradiance", multiscatter=True),
    ShadingOptions(diffuse="irradiance", dominant=True, multiscatter=True),
)
SH, IRRADIANCE, DOMINANT, MULTISCATTER, BOTH = OPTIONS
CASES = [(options, known) for options in OPTIONS[:2] for known in ("open", "visibility", "indirect")]
CASES += [(IRRADIANCE, "ambient"), (DOMINANT, "open"), (MULTISCATTER, "open"), (BOTH, "open")]
CASES += [(replace(BOTH, diffuse="sh"), "indirect"), *((options, "visibility") for options in OPTIONS[2:])]
"""Options, and what of the light is known to be blocked."""


@pytest.fixture(scope="module")
def radiance() -> np.ndarray:
    return np.random.default_rng(3).uniform(0.1, 3, (16, 32, 3))


def outgoing(points: ShadingPoints, radiance: np.ndarray, options: ShadingOptions) -> np.ndarray:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    return shade(points, light, options).total().numpy().astype(np.float64)


@pytest.mark.parametrize(("options", "known"), CASES)
def test_terms_against_the_oracle(
    options: ShadingOptions, known: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    levels, values = level_maps(light), shading_values(rng, known)
    terms = shade(points_of(values), light, options)
    expected = np.array([exact_terms(values, levels, options, k) for k in range(N)])
    for n, term in enumerate(vars(terms.filled()).values()):
        got = np.broadcast_to(term.numpy(), (3, N)).T
        np.testing.assert_allclose(got, expected[:, n], rtol=1e-5, atol=5e-5)
    np.testing.assert_allclose(terms.total().numpy().T, expected.sum(1), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(("options", "known"), CASES)
def test_derivatives_of_each_parameter(
    options: ShadingOptions, known: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    """Random weights per point, term and colour; differences of the reference that straddle a texel or a
    level are left out."""
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    levels, values = level_maps(light), shading_values(rng, known)
    points, weight = points_of(values), rng.normal(size=(N, 3, 3))
    used = {name: getattr(points, name) for name, x in values.items() if x is not None}
    dr.enable_grad(list(used.values()))
    terms = vars(shade(points, light, options).filled()).values()
    dr.backward(sum(dr.dot(mi.Vector3f(term), vector(weight[:, n])) for n, term in enumerate(terms)))

    def value(name: str, k: int, x: Any) -> float:
        changed = values | {name: np.array(values[name], np.float64)}
        changed[name][k] = x
        return float((exact_terms(changed, levels, options, k) * weight[k]).sum())

    for name, array in used.items():
        gradient = np.array(dr.grad(array)).reshape(-1, N).T
        check_slopes(name, gradient, values[name], value, rng)
        if name != "radiance" or options.diffuse == "sh":
            assert np.abs(gradient).max() > 0, f"{name} receives no gradient"


@pytest.mark.parametrize(("options", "known"), CASES)
def test_derivative_of_the_light(
    options: ShadingOptions, known: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    """Through activation, prefilter, lookup and reflectance: outgoing radiance is linear in radiance, so any
    step will do."""
    points, weight = points_of(shading_values(rng, known)), rng.normal(size=(N, 3))
    raw = EnvironmentLight.from_radiance(radiance).raw
    dr.enable_grad(raw)
    total = shade(points, EnvironmentLight(raw).prefilter(), options).total()
    dr.backward(dr.dot(mi.Vector3f(total), vector(weight)))
    gradient = dr.grad(raw).numpy() / -np.expm1(-radiance)  # by d softplus / d raw, in terms of softplus

    def slope(step: np.ndarray) -> float:
        change = outgoing(points, radiance + step, options) - outgoing(points, radiance - step, options)
        return float((change * weight.T).sum() / 2)

    for _ in range(3):
        step = 0.02 * rng.normal(size=radiance.shape)
        assert abs((gradient * step).sum() - slope(step)) < 0.02 * 2e-3 * np.linalg.norm(gradient)
    texel = np.unravel_index(np.abs(gradient * -np.expm1(-radiance)).argmax(), gradient.shape)
    step = np.zeros_like(radiance)
    step[texel] = 0.05
    np.testing.assert_allclose(gradient[texel], slope(step) / 0.05, rtol=5e-3)


def test_white_furnace(rng: np.random.Generator) -> None:
    """Under constant light 1 a white metal returns A + B ≤ 1: what single scattering keeps."""
    light = EnvironmentLight.constant(1.0, 16).prefilter()
    values = shading_values(rng, "open")
    values["albedo"], values["metallic"] = np.ones((N, 3)), np.ones(N)
    points = points_of(values)
    total = shade(points, light, IRRADIANCE).total().numpy()
    cosine = (unit(values["normal"]) * unit(values["view"])).sum(1)
    a, b = brdf.split_sum(mi.Float(cosine.astype(np.float32)), points.roughness)
    np.testing.assert_allclose(total, np.broadcast_to(np.array(a + b), (3, N)), atol=1e-4)
    assert total.max() < 1 + 1e-4
    for k in range(0, N, 10):
        assert abs(total[0, k] - sum(reference.split_sum(cosine[k], values["roughness"][k]))) < 1e-3


def test_the_diffuse_base_gets_what_the_specular_layer_leaves(rng: np.random.Generator) -> None:
    """Whatever its visibility; a white dielectric in the furnace returns 1."""
    light = EnvironmentLight.constant(1.0, 16).prefilter()
    values = shading_values(rng, "visibility")
    values["albedo"], values["metallic"] = np.ones((N, 3)), np.zeros(N)
    points = points_of(values)
    free = shade(points.replaced(visibility=None), light, IRRADIANCE)
    np.testing.assert_allclose(free.total().numpy(), 1, atol=1e-3)
    assert free.diffuse.numpy().min() < 0.955 < free.diffuse.numpy().max()
    np.testing.assert_array_equal(shade(points, light, IRRADIANCE).diffuse.numpy(), free.diffuse.numpy())


def test_visibility_selects_between_light_and_indirect(
    radiance: np.ndarray, rng: np.random.Generator
) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    points = points_of(shading_values(rng, "indirect"))
    free = shade(points.replaced(visibility=None, indirect=None), light, ShadingOptions()).specular.numpy()
    visible = shade(points.replaced(visibility=dr.ones(mi.Float, N)), light, SH)
    np.testing.assert_allclose(visible.specular.numpy(), free, rtol=1e-6)
    assert dr.all(visible.indirect == 0, axis=None)
    hidden = shade(points.replaced(visibility=dr.zeros(mi.Float, N)), light, SH)
    assert dr.all(hidden.specular == 0, axis=None) and dr.all(hidden.indirect > 0, axis=None)


def test_mirror_direction() -> None:
    normal, view = mi.Vector3f(0, 1, 0), dr.normalize(mi.Vector3f(1, 1, 0))
    np.testing.assert_allclose(reflect(view, normal).numpy().ravel(), [-(0.5**0.5), 0.5**0.5, 0], atol=1e-6)


def test_safe_normalize() -> None:
    v = mi.Vector3f([3e-30, 3, 3e18, 0, 0], [0, 0, 0, 0, 1e-3], [4e-30, 4, 4e18, 0, 0])
    dr.enable_grad(v)
    n = safe_normalize(v)
    dr.backward(n.x + 2 * n.y + 3 * n.z)
    expected = [[0.0, 0, 1], [0.6, 0, 0.8], [0.6, 0, 0.8], [0.0, 0, 1], [0.0, 1, 0]]
    np.testing.assert_allclose(n.numpy().T, expected, atol=1e-6)
    gradient = dr.grad(v).numpy().T
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient[[0, 3]], 0)
    across = np.array([1, 2, 3]) - (0.6 + 2.4) * np.array([0.6, 0, 0.8])
    np.testing.assert_allclose(gradient[1], across / 5, atol=1e-6)


@pytest.mark.parametrize("options", OPTIONS)
def test_degenerate_points_stay_finite(options: ShadingOptions, radiance: np.ndarray) -> None:
    """Zero normals and views, grazing, from behind, poles, roughness and colours at their ends and beyond:
    finite values and gradients."""
    normals: list[Any] = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0]]
    normals += [[1e-25, 0, 0], [1e15, 0, 1e15]]
    views = [[0, 0, 1], [0, 0, 0], [1, 0, 1e-6], [0, 1, 0], [0, -1, 0]]
    ends = (-1.0, 0.0, 0.3, 1.0, 7.0), (0.0, 1.0), (0.0, 0.5, 1.0, 1.5, -3.0, 1e6)
    n, v, r, m, a = (np.array(x, np.float64) for x in zip(*product(normals, views, *ends), strict=True))
    colours = {"albedo": np.tile(a[:, None], 3), "radiance": np.ones((len(a), 3)), "indirect": 0 * n}
    points = points_of(
        {"normal": n, "view": v, "metallic": m, "roughness": r, "visibility": np.full(len(r), 0.5), **colours}
    )
    raw = EnvironmentLight.from_radiance(radiance).raw
    names = ("normal", "view", "albedo", "metallic", "roughness", "indirect")
    inputs = [getattr(points, name) for name in names]
    dr.enable_grad(raw, *inputs)
    total = shade(points, EnvironmentLight(raw).prefilter(), options).total()
    dr.backward(total)
    for array in (total, dr.grad(raw).array, *map(dr.grad, inputs)):
        assert dr.all(dr.isfinite(array), axis=None)
    assert total.numpy()[:, a >= 0].min() > -1e-6
    inside = (a >= 0) & (a <= 1) & (r >= 0) & (r <= 1)
    assert (dr.grad(points.indirect).numpy()[:, inside] != 0).all(), "indirect light of 0 gets a gradient"
    leaf = mi.Float(r.astype(np.float32))
    dr.enable_grad(leaf)
    dr.set_grad(leaf, 1)
    total = shade(points.replaced(roughness=leaf), EnvironmentLight(raw).prefilter(), options).total()
    assert dr.all(dr.isfinite(dr.forward_to(total)), axis=None)


def test_bad_arguments(radiance: np.ndarray, rng: np.random.Generator) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    points = points_of(shading_values(rng, "open"))
    with pytest.raises(InputError, match="is not allowed; use sh or irradiance"):
        ShadingOptions(diffuse="lambert")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="missing"):
        shade(points.replaced(radiance=None), light, ShadingOptions())
