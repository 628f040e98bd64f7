"""Reflectance models: terms and derivatives against the float64 reference, degenerate points, lights."""

from itertools import product
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference import models
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, safe_normalize
from mi_refgs.shade.reflectance import TraceContext
from mi_refgs.shade.shading import Shading, shade, trace
from mi_refgs.surfels.table import Surfels
from tests.helpers import check_slopes, refused, unit, vector, with_grad
from tests.scenes.shading_points import N, exact_light, exact_terms, points_of, shading_values

MAP = np.random.default_rng(3).uniform(0.1, 3, (16, 32, 3))
MATERIALS = ("albedo", "metallic", "roughness")
BLOCKED = ("visibility", "indirect")
DIRECTIONS = 7


def irradiance(**options: Any) -> Shading:
    return Shading(diffuse="irradiance", **options)


CASES: dict[str, tuple[Shading, tuple[str, ...]]] = {
    "SH, visibility": (Shading(), ("radiance", *MATERIALS, "visibility")),
    "SH, dominant, indirect": (Shading(dominant=True), ("radiance", *MATERIALS, *BLOCKED)),
    "irradiance, ambient": (irradiance(), (*MATERIALS, "ambient")),
    "dominant, residual": (irradiance(dominant=True), (*MATERIALS, *BLOCKED, "residual")),
    "mirror": (Shading("pixel", "mirror"), ("radiance", "metallic")),
    "gaussian_shader": (Shading("surfel", "gaussian_shader"), ("radiance", "tint", "roughness")),
    "monte_carlo, occluded": (
        Shading("surfel", "monte_carlo", occlusion=True, directions=DIRECTIONS),
        ("albedo", "roughness", "incident", "free"),
    ),
}
"""Options of each model, and the attributes of its points."""

EVERY = pytest.mark.parametrize(("shading", "names"), CASES.values(), ids=CASES)


def flat(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list) else [value]


def shaded(points: ShadingPoints, light: EnvironmentLight, shading: Shading) -> RadianceTerms:
    return shade(points, shading.light_of(light), shading)


def weighted(terms: RadianceTerms, weight: np.ndarray) -> Any:
    """Sum of the terms with weights (N, 3, 3) per point, term and colour."""
    each = enumerate(vars(terms.filled()).values())
    return sum(dr.dot(mi.Vector3f(term), vector(weight[:, n])) for n, term in each)


@EVERY
def test_terms_match_reference(shading: Shading, names: tuple[str, ...], rng: np.random.Generator) -> None:
    light, values = EnvironmentLight.from_radiance(MAP), shading_values(rng, names)
    expected = exact_terms(values, exact_light(light.prefilter()), shading)
    terms = shaded(points_of(values), light, shading)
    rtol, atol = (1e-5, 5e-5) if shading.reflectance == "split_sum" else (1e-3, 2e-4)
    for n, term in enumerate(vars(terms.filled()).values()):
        got = np.broadcast_to(term.numpy(), (3, N)).T
        np.testing.assert_allclose(got, expected[:, n], rtol=rtol, atol=atol)
    np.testing.assert_allclose(terms.total().numpy().T, expected.sum(1), rtol=rtol, atol=2 * atol)


@EVERY
def test_attribute_derivatives(shading: Shading, names: tuple[str, ...], rng: np.random.Generator) -> None:
    """With random weights per point, term and colour, against the slopes of the float64 reference; the
    tangent is the transpose of the adjoint."""
    light, values = EnvironmentLight.from_radiance(MAP), shading_values(rng, names)
    exact, points, weight = exact_light(light.prefilter()), points_of(values), rng.normal(size=(N, 3, 3))
    used = with_grad({name: getattr(points, name) for name in values if name != "free"})
    dr.backward(weighted(shaded(points, light, shading), weight))
    gradients = {n: [np.array(dr.grad(x)).reshape(-1, N).T for x in flat(a)] for n, a in used.items()}

    def value(name: str, k: int, x: Any) -> float:
        one = {n: other[k : k + 1] for n, other in values.items()} | {name: np.asarray(x)[None]}
        return float((exact_terms(one, exact, shading) * weight[k]).sum())

    for name, parts in gradients.items():
        gradient = np.stack(parts, 1).reshape(N, *values[name].shape[1:])
        if name == "normal" and shading.reflectance == "monte_carlo":
            assert not gradient.any(), "the normal is detached"
            continue
        check_slopes(name, gradient, values[name], value, rng)
        assert np.abs(gradient).max() > 0, f"{name} receives no gradient"

    again, expected = points_of(values), 0.0
    for name in used:
        for part, gradient in zip(flat(getattr(again, name)), gradients[name], strict=True):
            tangent = rng.normal(size=gradient.shape).astype(np.float32)
            with_grad(part, mi.Float(tangent[:, 0]) if tangent.shape[1] == 1 else type(part)(vector(tangent)))
            expected += float((tangent * gradient).sum())
    total = weighted(shaded(again, light, shading), weight)
    dr.forward_to(total)
    assert float(dr.sum(dr.grad(total))[0]) == pytest.approx(expected, rel=2e-3, abs=2e-2)


@EVERY
def test_derivative_of_light(shading: Shading, names: tuple[str, ...], rng: np.random.Generator) -> None:
    """Outgoing radiance is linear in that of the light, so that any step will do; in both modes."""
    points, weight = points_of(shading_values(rng, names)), rng.normal(size=(N, 1, 3)) * np.ones((1, 3, 1))
    raw, activation = EnvironmentLight.from_radiance(MAP).raw, -np.expm1(-MAP)  # d softplus / d raw
    dr.enable_grad(raw)
    dr.backward(weighted(shaded(points, EnvironmentLight(raw), shading), weight))
    gradient = dr.grad(raw).numpy().astype(np.float64) / activation

    def slope(direction: np.ndarray, step: float) -> float:
        sides = []
        for sign in (1, -1):
            light = EnvironmentLight.from_radiance(MAP + sign * step * direction)
            total = shaded(points, light, shading).total().numpy().astype(np.float64)
            sides.append(np.sum(total * weight[:, 0].T))
        return float(sides[0] - sides[1]) / (2 * step)

    direction = rng.normal(size=MAP.shape)
    difference = slope(direction, 0.02)
    assert abs((gradient * direction).sum() - difference) < 2e-3 * np.linalg.norm(gradient)
    one = np.zeros_like(MAP)
    one.flat[np.abs(gradient * activation).argmax()] = 1
    assert (gradient * one).sum() == pytest.approx(slope(one, 0.05), rel=5e-3)
    leaf = with_grad(mi.TensorXf(raw), mi.TensorXf((direction / activation).astype(np.float32)))
    found = weighted(shaded(points, EnvironmentLight(leaf), shading), weight)
    dr.forward_to(found)
    assert float(dr.sum(dr.grad(found))[0]) == pytest.approx(difference, rel=1e-2, abs=0.05)


@EVERY
def test_degenerate_points_stay_finite(shading: Shading, names: tuple[str, ...]) -> None:
    """Zero normals and views, grazing, from behind, poles, roughness and colours at their ends and beyond."""
    normals: list[Any] = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 0, -1], [0, 1, 0], [0, -1, 0]]
    normals += [[1e-25, 0, 0], [1e15, 0, 1e15]]
    views = [[0, 0, 1], [0, 0, 0], [1, 0, 1e-6], [0, 1, 0], [0, -1, 0]]
    ends = (-1.0, 0.0, 0.3, 1.0, 7.0), (0.0, 1.0), (0.0, 0.5, 1.0, 1.5, -3.0, 1e6)
    n, v, r, m, a = (np.array(x, np.float64) for x in zip(*product(normals, views, *ends), strict=True))
    values = shading_values(np.random.default_rng(0), names, len(a))
    extreme = {"normal": n, "view": v, "roughness": r, "metallic": m, "indirect": 0 * n, "residual": 0 * n}
    extreme |= {"albedo": np.tile(a[:, None], 3), "tint": np.tile(a[:, None], 3)}
    points = points_of(values | {name: x for name, x in extreme.items() if name in values})
    leaves = [part for name in values if name != "free" for part in flat(getattr(points, name))]
    raw = EnvironmentLight.from_radiance(MAP).raw
    dr.enable_grad(raw, leaves)
    total = shaded(points, EnvironmentLight(raw), shading).total()
    dr.backward(total)
    for array in (total, dr.grad(raw).array, *map(dr.grad, leaves)):
        assert dr.all(dr.isfinite(array), axis=None)
    inside = (a >= 0) & (a <= 1) & (r >= 0) & (r <= 1)
    assert total.numpy()[:, a >= 0 if shading.reflectance == "split_sum" else inside].min() > -1e-6
    if "indirect" in names:
        assert (dr.grad(points.indirect).numpy()[:, inside] != 0).all(), "indirect light of 0 gets a gradient"
    if "roughness" in names:
        leaf = with_grad(mi.Float(r.astype(np.float32)), 1)
        total = shaded(points.replaced(roughness=leaf), EnvironmentLight(raw), shading).total()
        assert dr.all(dr.isfinite(dr.forward_to(total)), axis=None)


def test_safe_normalize() -> None:
    v = with_grad(mi.Vector3f([3e-30, 3, 3e18, 0, 0], [0, 0, 0, 0, 1e-3], [4e-30, 4, 4e18, 0, 0]))
    n = safe_normalize(v)
    dr.backward(n.x + 2 * n.y + 3 * n.z)
    expected = [[0.0, 0, 1], [0.6, 0, 0.8], [0.6, 0, 0.8], [0.0, 0, 1], [0.0, 1, 0]]
    np.testing.assert_allclose(n.numpy().T, expected, atol=1e-6)
    gradient = dr.grad(v).numpy().T
    assert np.isfinite(gradient).all()
    np.testing.assert_allclose(gradient[[0, 3]], 0)
    across = np.array([1, 2, 3]) - (0.6 + 2.4) * np.array([0.6, 0, 0.8])
    np.testing.assert_allclose(gradient[1], across / 5, atol=1e-6)


def test_lights_give_same_to_model() -> None:
    """A constant light is its own filter, and one look-up of the map needs no filter."""
    d, roughness = mi.Vector3f(0.6, 0, 0.8), mi.Float(0.3)
    colour = with_grad(mi.Color3f(0.5, 1, 2))
    light = ConstantLight(colour)
    for value in (light.radiance(d), light.irradiance(d), light.specular(d, roughness)):
        np.testing.assert_array_equal(value.numpy(), colour.numpy())
    dr.backward(dr.sum(light.specular(d, roughness)))
    np.testing.assert_array_equal(dr.grad(colour).numpy(), np.ones((3, 1)))
    environment = EnvironmentLight.from_radiance(MAP)
    d = vector(unit(np.random.default_rng(0).normal(size=(100, 3))))
    expected = environment.prefilter().radiance(d).numpy()
    np.testing.assert_array_equal(environment.unfiltered().radiance(d).numpy(), expected)
    refused(lambda: environment.unfiltered().irradiance(d), "not filtered")


def test_model_of_mirrors_does_not_pay_for_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(EnvironmentLight, "prefilter", lambda self: pytest.fail("filtered"))
    light = CASES["mirror"][0].light_of(EnvironmentLight.from_radiance(MAP))
    assert light is not None and dr.all(light.radiance(mi.Vector3f(0, 0, 1)) > 0, axis=None)


def test_hemisphere_is_blocked_where_mesh_stands() -> None:
    """Points before a large wall get light from the other side alone."""
    n = 5
    wall = np.array([[1, -50, -50], [1, 50, -50], [1, 50, 50], [1, -50, 50]], np.float32)
    occluder = Occluder(Mesh(wall, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), 1e-3))
    normal = vector(np.tile([0, 1.0, 0], (n, 1)))
    place = mi.Point3f(vector(np.linspace(0, 0.5, n)[:, None] * [1.0, 0, 0]))
    points = ShadingPoints(normal, normal, position=place)
    context = TraceContext(occluder, Surfels({}), None, mi.Point3f(0, 9, 0), -normal)
    free = np.array(trace(points, context, CASES["monte_carlo, occluded"][0]).free)
    directions = models.hemisphere(DIRECTIONS, np.array([0, 1.0, 0]))
    blocked = directions[:, 0] * 50 > 1  # the wall is as good as infinite
    assert 0 < blocked.sum() < DIRECTIONS
    for k in range(n):
        np.testing.assert_array_equal([not free[k] >> j & 1 for j in range(DIRECTIONS)], blocked)


def test_missing_radiance_is_refused() -> None:
    points = points_of(shading_values(np.random.default_rng(0), MATERIALS))
    refused(lambda: shaded(points, EnvironmentLight.from_radiance(MAP), Shading()), "radiance: missing")
