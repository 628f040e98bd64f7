"""Shading: terms and every derivative against the float64 reference, energy, and degenerate points."""

from __future__ import annotations

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
from mi_refgs.shade.points import reflect, safe_normalize
from mi_refgs.shade.split_sum import shade
from tests.helpers import check_slopes, level_maps, unit
from tests.scenes.shading_points import N, exact_terms, points_of, shading_values

CASES = [(d, o) for d in ("sh", "irradiance") for o in ("open", "visibility", "indirect")]
CASES += [("irradiance", "ambient")]


@pytest.fixture(scope="module")
def radiance() -> np.ndarray:
    return np.random.default_rng(3).uniform(0.1, 3, (16, 32, 3))


@pytest.mark.parametrize(("diffuse", "occlusion"), CASES)
def test_terms_against_the_oracle(
    diffuse: Any, occlusion: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    levels, values = level_maps(light), shading_values(rng, occlusion)
    terms = shade(points_of(values), light, ShadingOptions(diffuse=diffuse))
    expected = np.array([exact_terms(values, levels, diffuse, k) for k in range(N)])
    for n, term in enumerate(vars(terms.filled()).values()):
        np.testing.assert_allclose(np.broadcast_to(term.numpy(), (3, N)).T, expected[:, n], atol=2e-4)
    np.testing.assert_allclose(terms.total().numpy().T, expected.sum(1), atol=4e-4)


@pytest.mark.parametrize(("diffuse", "occlusion"), CASES)
def test_derivatives_of_each_parameter(
    diffuse: Any, occlusion: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    """Random weights per point, term and colour; differences of the reference that straddle a texel or a
    level are left out."""
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    levels, values = level_maps(light), shading_values(rng, occlusion)
    points = points_of(values)
    used = {n: getattr(points, n) for n, x in values.items() if x is not None}
    for array in used.values():
        dr.enable_grad(array)
    weight = rng.normal(size=(N, 3, 3))
    terms = shade(points, light, ShadingOptions(diffuse=diffuse))
    loss = sum(
        dr.dot(mi.Vector3f(term), mi.Vector3f(weight[:, n].T.astype(np.float32)))
        for n, term in enumerate(vars(terms.filled()).values())
    )
    dr.backward(loss)

    def value(name: str, k: int, x: Any) -> float:
        changed = dict(values)
        changed[name] = np.array(values[name], np.float64)
        changed[name][k] = x
        return float((exact_terms(changed, levels, diffuse, k) * weight[k]).sum())

    for name, array in used.items():
        gradient = np.array(dr.grad(array)).reshape(-1, N).T
        check_slopes(name, gradient, values[name], value, rng)
        if name not in ("radiance",) or diffuse == "sh":
            assert np.abs(gradient).max() > 0, f"{name} receives no gradient"


@pytest.mark.parametrize(("diffuse", "occlusion"), CASES)
def test_derivative_of_the_light(
    diffuse: Any, occlusion: str, radiance: np.ndarray, rng: np.random.Generator
) -> None:
    """Through activation, prefilter, lookup and reflectance: outgoing radiance is linear in radiance, so any
    step will do."""
    points = points_of(shading_values(rng, occlusion))
    weight = mi.Vector3f(rng.normal(size=(3, N)).astype(np.float32))
    raw = EnvironmentLight.from_radiance(radiance).raw
    dr.enable_grad(raw)
    dr.backward(
        dr.dot(
            mi.Vector3f(
                shade(points, EnvironmentLight(raw).prefilter(), ShadingOptions(diffuse=diffuse)).total()
            ),
            weight,
        )
    )
    gradient = dr.grad(raw).numpy().astype(np.float64)

    def loss(map_: np.ndarray) -> float:
        total = shade(
            points, EnvironmentLight.from_radiance(map_).prefilter(), ShadingOptions(diffuse=diffuse)
        ).total()
        return float((total.numpy().astype(np.float64) * weight.numpy()).sum())

    slope = -np.expm1(-radiance)  # d softplus / d raw, in terms of softplus
    for _ in range(3):
        step = rng.normal(size=radiance.shape)
        difference = (loss(radiance + 0.02 * step) - loss(radiance - 0.02 * step)) / 0.04
        scale = np.linalg.norm(gradient / slope)
        assert abs((gradient / slope * step).sum() - difference) < 2e-3 * scale
    texel = np.unravel_index(np.abs(gradient).argmax(), gradient.shape)
    step = np.zeros_like(radiance)
    step[texel] = 0.05
    difference = (loss(radiance + step) - loss(radiance - step)) / 0.1
    np.testing.assert_allclose(gradient[texel] / slope[texel], difference, rtol=5e-3)


def test_white_furnace(rng: np.random.Generator) -> None:
    """Under constant light 1 a white metal returns A + B ≤ 1: what single scattering keeps."""
    light = EnvironmentLight.constant(1.0, 16).prefilter()
    values = shading_values(rng, "open")
    values["albedo"], values["metallic"] = np.ones((N, 3)), np.ones(N)
    points = points_of(values)
    total = shade(points, light, ShadingOptions(diffuse="irradiance")).total().numpy()
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
    free = shade(points.replaced(visibility=None), light, ShadingOptions(diffuse="irradiance"))
    np.testing.assert_allclose(free.total().numpy(), 1, atol=1e-3)
    assert free.diffuse.numpy().min() < 0.955 < free.diffuse.numpy().max()
    np.testing.assert_array_equal(
        shade(points, light, ShadingOptions(diffuse="irradiance")).diffuse.numpy(), free.diffuse.numpy()
    )


def test_visibility_selects_between_light_and_indirect(
    radiance: np.ndarray, rng: np.random.Generator
) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    points = points_of(shading_values(rng, "indirect"))
    free = shade(points.replaced(visibility=None, indirect=None), light, ShadingOptions()).specular.numpy()
    visible = shade(points.replaced(visibility=mi.Float(np.ones(N, np.float32))), light, ShadingOptions())
    np.testing.assert_allclose(visible.specular.numpy(), free, rtol=1e-6)
    assert dr.all(visible.indirect == 0, axis=None)
    hidden = shade(points.replaced(visibility=mi.Float(np.zeros(N, np.float32))), light, ShadingOptions())
    assert dr.all(hidden.specular == 0, axis=None) and dr.all(hidden.indirect > 0, axis=None)


def test_mirror_direction() -> None:
    normal, view = mi.Vector3f(0, 1, 0), dr.normalize(mi.Vector3f(1, 1, 0))
    np.testing.assert_allclose(reflect(view, normal).numpy().ravel(), [-(0.5**0.5), 0.5**0.5, 0], atol=1e-6)


def test_safe_normalize() -> None:
    v = mi.Vector3f([3e-30, 3, 3e18, 0, 0], [0, 0, 0, 0, 1e-3], [4e-30, 4, 4e18, 0, 0])
    dr.enable_grad(v)
    n = safe_normalize(v)
    dr.backward(n.x + 2 * n.y + 3 * n.z)
    np.testing.assert_allclose(
        n.numpy().T, [[0.0, 0, 1], [0.6, 0, 0.8], [0.6, 0, 0.8], [0.0, 0, 1], [0.0, 1, 0]], atol=1e-6
    )
    gradient = dr.grad(v).numpy().T
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient[[0, 3]], 0)
    np.testing.assert_allclose(
        gradient[1], (np.array([1, 2, 3]) - (0.6 + 2.4) * np.array([0.6, 0, 0.8])) / 5, atol=1e-6
    )


@pytest.mark.parametrize("diffuse", ["sh", "irradiance"])
def test_degenerate_points_stay_finite(diffuse: Any, radiance: np.ndarray) -> None:
    """Zero normals and views, grazing, from behind, roughness 0 and 1, poles: finite values and gradients."""
    normals = np.array(
        [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0], [1e-25, 0, 0], [1e15, 0, 1e15]]
    )
    views = np.array([[0, 0, 1], [0, 0, 0], [0, 0, 1], [1, 0, 1e-6], [0, 1, 0], [0, -1, 0]])
    cases = [(n, v, r, m) for n in normals for v in views for r in (0.0, 1.0, 0.3) for m in (0.0, 1.0)]
    n, v, r, m = (np.array(x, np.float64) for x in zip(*cases, strict=True))
    count = len(cases)
    points = points_of(
        {
            "normal": n,
            "view": v,
            "albedo": np.tile([0.0, 0.5, 1.0], (count, 1)),
            "metallic": m,
            "roughness": r,
            "radiance": np.ones((count, 3)),
            "visibility": np.full(count, 0.5),
            "indirect": np.zeros((count, 3)),
        }
    )
    raw = EnvironmentLight.from_radiance(radiance).raw
    inputs = [
        getattr(points, name) for name in ("normal", "view", "albedo", "metallic", "roughness", "indirect")
    ]
    dr.enable_grad(raw, *inputs)
    total = shade(points, EnvironmentLight(raw).prefilter(), ShadingOptions(diffuse=diffuse)).total()
    dr.backward(total)
    for array in (total, raw.array, dr.grad(raw).array, *map(dr.grad, inputs)):
        assert dr.all(dr.isfinite(array), axis=None)
    assert dr.all(dr.grad(points.indirect) != 0, axis=None), (
        "indirect light of exactly 0 must receive a gradient"
    )


def test_bad_arguments(radiance: np.ndarray, rng: np.random.Generator) -> None:
    light = EnvironmentLight.from_radiance(radiance).prefilter()
    points = points_of(shading_values(rng, "open"))
    with pytest.raises(InputError, match="is not allowed; use sh or irradiance"):
        ShadingOptions(diffuse="lambert")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="missing"):
        shade(points.replaced(radiance=None), light, ShadingOptions())
