"""Reflectance models of the baselines: terms and derivatives against the float64 reference, images, fits."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference import models
from mi_refgs.render.pipeline import Request, SurfelScene, render
from mi_refgs.shade import brdf
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.light import ConstantLight, RotatedLight
from mi_refgs.shade.light.lobe_matrices import LEVEL_ROUGHNESS
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance import MODELS, TraceContext
from mi_refgs.shade.shading import Shading, shade
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.attributes import ATTRIBUTES
from mi_refgs.surfels.table import Surfels
from tests.helpers import check_slopes, level_maps, unit, vector

N, DIRECTIONS = 40, 7
MAP = np.random.default_rng(3).uniform(0.1, 3, (16, 32, 3))

CASES = {
    "mirror": Shading("pixel", "mirror"),
    "gaussian_shader": Shading("surfel", "gaussian_shader"),
    "monte_carlo": Shading("surfel", "monte_carlo", directions=DIRECTIONS),
    "monte_carlo, occluded": Shading("surfel", "monte_carlo", occlusion=True, directions=DIRECTIONS),
}


def scene(name: str, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Attributes of N points that face the camera, whose normals and views are of any length."""
    view = unit(rng.normal(size=(N, 3)))
    values: dict[str, Any] = {
        "normal": unit(unit(rng.normal(size=(N, 3))) + 1.3 * view) * rng.uniform(0.5, 2, (N, 1)),
        "view": view * rng.uniform(0.5, 2, (N, 1)),
    }
    if name == "mirror":
        values |= {"radiance": rng.uniform(0.1, 2, (N, 3)), "metallic": rng.uniform(0.1, 0.9, N)}
    elif name == "gaussian_shader":
        values |= {"radiance": rng.uniform(0.1, 2, (N, 3)), "tint": rng.uniform(0.1, 0.9, (N, 3))}
        values |= {"roughness": rng.uniform(0.05, 0.95, N)}
    else:
        values |= {"albedo": rng.uniform(0.1, 0.9, (N, 3)), "roughness": rng.uniform(0.05, 0.95, N)}
        values |= {"incident": 0.3 * rng.normal(size=(N, 9, 3))}
    if name.endswith("occluded"):
        values["free"] = rng.integers(0, 2**DIRECTIONS, N)
    return values


def points_of(values: dict[str, np.ndarray]) -> ShadingPoints:
    def array(x: np.ndarray) -> Any:
        if x.dtype.kind == "i":
            return mi.UInt64(x.astype(np.uint64))
        if x.ndim == 1:
            return mi.Float(x.astype(np.float32))
        if x.ndim == 3:
            return [mi.Color3f(vector(x[:, i])) for i in range(x.shape[1])]
        return vector(x)

    arrays = {name: array(x) for name, x in values.items()}
    colours = {n: mi.Color3f(arrays[n]) for n in ("radiance", "albedo", "tint") if n in arrays}
    return ShadingPoints(**arrays | colours)


def exact_terms(
    name: str, values: dict[str, np.ndarray], maps: list[np.ndarray], k: int, normal: Any
) -> np.ndarray:
    """Terms (T, 3) of point k in float64. `normal`: about which the directions of the hemisphere are."""
    one = {key: np.asarray(x[k], np.float64).reshape(1, -1) for key, x in values.items() if key != "free"}
    light = models.Light(maps, tuple(LEVEL_ROUGHNESS), brdf.table().astype(np.float64))
    about = (normal / np.linalg.norm(normal))[None]
    free = np.array([[values["free"][k] >> j & 1 for j in range(DIRECTIONS)]]) if "free" in values else None
    options = models.Options(directions=DIRECTIONS, free=free, detached_normal=about)
    points = models.Points(one.pop("normal"), one.pop("view"), one)
    model = name.partition(",")[0]
    terms = models.MODELS[model](points, light, options, [])
    return np.concatenate(terms)[: 3 if model == "monte_carlo" else 2]


def flat(value: Any) -> list[Any]:
    return list(value) if isinstance(value, list) else [value]


def shaded(name: str, points: ShadingPoints, light: EnvironmentLight) -> list[Any]:
    return list(shade(points, CASES[name].light_of(light), CASES[name]).known().values())


# ---------------- terms and derivatives ----------------


@pytest.mark.parametrize("name", CASES)
def test_terms_against_oracle(name: str, rng: np.random.Generator) -> None:
    light, values = EnvironmentLight.from_radiance(MAP), scene(name, rng)
    maps = level_maps(light.prefilter())
    expected = np.array([exact_terms(name, values, maps, k, values["normal"][k]) for k in range(N)])
    terms = shaded(name, points_of(values), light)
    assert len(terms) == expected.shape[1]
    for n, term in enumerate(terms):
        np.testing.assert_allclose(term.numpy().T, expected[:, n], rtol=1e-3, atol=2e-4)


@pytest.mark.parametrize("name", CASES)
def test_derivatives_of_each_attribute(name: str, rng: np.random.Generator) -> None:
    """With random weights per point, term and colour, against the slopes of the float64 reference; the
    tangent is the transpose of the adjoint."""
    light, values = EnvironmentLight.from_radiance(MAP), scene(name, rng)
    maps, points = level_maps(light.prefilter()), points_of(values)
    used = {n: getattr(points, n) for n in values if n != "free"}
    dr.enable_grad(list(used.values()))
    terms = shaded(name, points, light)
    weight = rng.normal(size=(N, len(terms), 3))

    def loss() -> Any:
        return sum(dr.dot(mi.Vector3f(term), vector(weight[:, n])) for n, term in enumerate(terms))

    dr.backward(loss(), dr.ADFlag.ClearInterior)
    gradients = {n: [np.array(dr.grad(x)).reshape(-1, N).T for x in flat(a)] for n, a in used.items()}

    def value(attribute: str, k: int, x: Any) -> float:
        changed = values | {attribute: np.array(values[attribute], np.float64)}
        changed[attribute][k] = x
        return float((exact_terms(name, changed, maps, k, values["normal"][k]) * weight[k]).sum())

    for attribute, parts in gradients.items():
        gradient = np.stack(parts, 1).reshape(N, *values[attribute].shape[1:])
        if attribute == "normal" and name.startswith("monte_carlo"):
            assert not gradient.any(), "the normal is detached"
            continue
        check_slopes(attribute, gradient, values[attribute], value, rng)
        assert np.abs(gradient).max() > 0, f"{attribute} receives no gradient"

    again = points_of(values)
    product = 0.0
    for attribute in used:
        for part, gradient in zip(flat(getattr(again, attribute)), gradients[attribute], strict=True):
            tangent = rng.normal(size=gradient.shape).astype(np.float32)
            dr.enable_grad(part)
            dr.set_grad(
                part, mi.Float(tangent[:, 0]) if tangent.shape[1] == 1 else type(part)(vector(tangent))
            )
            product += float((tangent * gradient).sum())
    terms = shaded(name, again, light)
    total = loss()
    dr.forward_to(total)
    assert float(dr.sum(dr.grad(total))[0]) == pytest.approx(product, rel=2e-3, abs=2e-2)


@pytest.mark.parametrize("name", CASES)
def test_derivative_of_light(name: str, rng: np.random.Generator) -> None:
    """Outgoing radiance is linear in that of the light, so that any step will do; in both modes."""
    points, weight = points_of(scene(name, rng)), vector(rng.normal(size=(N, 3)))
    raw, direction = EnvironmentLight.from_radiance(MAP).raw, rng.normal(size=MAP.shape)
    dr.enable_grad(raw)
    total = RadianceTerms(*shaded(name, points, EnvironmentLight(raw))).total()
    dr.backward(dr.dot(mi.Vector3f(total), weight))
    gradient, slope = dr.grad(raw).numpy().astype(np.float64), -np.expm1(-MAP)

    def loss(map_: np.ndarray) -> float:
        total = RadianceTerms(*shaded(name, points, EnvironmentLight.from_radiance(map_))).total()
        return float((total.numpy().astype(np.float64) * weight.numpy()).sum())

    difference = (loss(MAP + 0.02 * direction) - loss(MAP - 0.02 * direction)) / 0.04
    assert abs((gradient / slope * direction).sum() - difference) < 2e-3 * np.linalg.norm(gradient / slope)
    leaf = mi.TensorXf(raw)
    dr.enable_grad(leaf)
    dr.set_grad(leaf, mi.TensorXf((direction / slope).astype(np.float32)))
    total = RadianceTerms(*shaded(name, points, EnvironmentLight(leaf))).total()
    found = dr.dot(mi.Vector3f(total), weight)
    dr.forward_to(found)
    assert float(dr.sum(dr.grad(found))[0]) == pytest.approx(difference, rel=1e-2, abs=0.05)


@pytest.mark.parametrize("name", CASES)
def test_degenerate_points_stay_finite(name: str) -> None:
    """Normals of no length, from behind and at grazing angles, roughness beyond its range, a NaN of none."""
    rng = np.random.default_rng(0)
    values = scene(name, rng)
    values["normal"][:8] = [[0, 0, 0], [1e-30, 0, 0], [0, 1e18, 0], [0, 0, -1], [0, 1, 0], *np.eye(3)]
    values["view"][:8] = [[0, 1, 0], [0, 0, 0], [0, 0, 1], [0, 0, 1], [1, 0, 0], *-np.eye(3)]
    if "roughness" in values:
        values["roughness"][:6] = [0, 1, 0, 1, -1, 2]
    points, raw = points_of(values), EnvironmentLight.from_radiance(MAP).raw
    arrays = [part for n in values if n != "free" for part in flat(getattr(points, n))]
    dr.enable_grad(arrays, raw)
    total = RadianceTerms(*shaded(name, points, EnvironmentLight(raw))).total()
    dr.backward(total)
    for array in (total, dr.grad(raw).array, *map(dr.grad, arrays)):
        assert dr.all(dr.isfinite(array), axis=None)


# ---------------- lights ----------------


def test_lights_give_same_to_model() -> None:
    """A constant light is its own filter, and one look-up of the map needs no filter."""
    d, roughness = mi.Vector3f(0.6, 0, 0.8), mi.Float(0.3)
    colour = mi.Color3f(0.5, 1, 2)
    dr.enable_grad(colour)
    light = ConstantLight(colour)
    for value in (light.radiance(d), light.irradiance(d), light.specular(d, roughness)):
        np.testing.assert_array_equal(value.numpy(), colour.numpy())
    dr.backward(dr.sum(light.specular(d, roughness)))
    np.testing.assert_array_equal(dr.grad(colour).numpy(), np.ones((3, 1)))
    environment = EnvironmentLight.from_radiance(MAP)
    d = vector(unit(np.random.default_rng(0).normal(size=(100, 3))))
    expected = environment.prefilter().radiance(d).numpy()
    np.testing.assert_array_equal(environment.unfiltered().radiance(d).numpy(), expected)
    turned = RotatedLight(environment.unfiltered(), mi.Matrix3f(0, 0, 1, 0, 1, 0, -1, 0, 0))
    there = environment.unfiltered().radiance(mi.Vector3f(d.z, d.y, -d.x)).numpy()
    np.testing.assert_allclose(turned.radiance(d).numpy(), there, rtol=1e-6)
    for lookup in (turned.irradiance, lambda x: turned.specular(x, roughness)):
        with pytest.raises(InputError, match="not filtered"):
            lookup(d)


def test_model_of_mirrors_does_not_pay_for_filter() -> None:
    """Kernel launches of the light, forward and backward."""
    d = vector(unit(np.random.default_rng(0).normal(size=(100, 3))))

    def launches(name: str) -> int:
        raw = EnvironmentLight.from_radiance(MAP).raw
        dr.enable_grad(raw)
        dr.eval(raw, d)
        dr.kernel_history_clear()
        light: Any = CASES[name].light_of(EnvironmentLight(raw))
        dr.backward(dr.sum(light.radiance(d)))
        dr.eval(dr.grad(raw))
        return len(dr.kernel_history([dr.KernelType.JIT]))

    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        assert launches("mirror") + 4 <= launches("gaussian_shader")


# ---------------- images ----------------


def table(*channels: str, count: int = 60) -> Surfels:
    """Surfels on the unit sphere, with random materials and nearly opaque."""
    rng = np.random.default_rng(2)
    raw = {name: 0.4 * rng.normal(size=(count, ATTRIBUTES[name].width(2))) for name in channels}
    raw |= {"position": unit(rng.normal(size=(count, 3))), "rotation": rng.normal(size=(count, 4))}
    raw |= {"scale": np.full((count, 2), -1.2), "opacity": np.full((count, 1), 2.0)}
    return Surfels.from_numpy(raw)


@pytest.mark.parametrize("name", ["mirror", "gaussian_shader", "monte_carlo"])
def test_every_channel_of_image_gets_its_gradient(name: str) -> None:
    """And the channel that is missing is named."""
    model, light = MODELS[name], EnvironmentLight.from_radiance(MAP)
    dr.enable_grad(light.raw)
    extra = ("indirect_sh",) if name == "monte_carlo" else ()
    surfels = table(*model.required_attributes(ShadingOptions()), *extra)
    surfels.enable_grad()
    pose = np.eye(4)
    pose[2, 3] = -4
    camera = Camera.from_pose(24, 24, 30.0, 30.0, 12, 12, pose)
    shading = Shading(model.shaded_at[0], name)
    scene = SurfelScene(surfels, shading, shading.light_of(light))
    frame = render(scene, camera, Request(scene.all_aovs))
    assert frame.terms is not None
    np.testing.assert_allclose(frame.terms.total().numpy(), frame.radiance.numpy(), atol=1e-5)
    dr.backward(dr.sum(frame.radiance.x * frame.radiance.y + frame.radiance.z))
    for channel, tensor in (surfels.raw | {"light": light.raw}).items():
        gradient = dr.grad(tensor).numpy()
        assert np.isfinite(gradient).all() and gradient.any(), channel
    for missing in model.required_attributes(ShadingOptions()):
        with pytest.raises(InputError, match=missing):
            shading.require_inputs([other for other in surfels.raw if other != missing])


def test_hemisphere_is_blocked_where_mesh_stands() -> None:
    """Points before a large wall get light from the other side alone."""
    n = 5
    wall = np.array([[1, -50, -50], [1, 50, -50], [1, 50, 50], [1, -50, 50]], np.float32)
    occluder = Occluder(Mesh(wall, np.array([[0, 1, 2], [0, 2, 3]], np.uint32), 1e-3))
    normal = vector(np.tile([0, 1.0, 0], (n, 1)))
    place = mi.Point3f(vector(np.linspace(0, 0.5, n)[:, None] * [1.0, 0, 0]))
    points = ShadingPoints(normal, normal, position=place)
    context = TraceContext(occluder, table(), None, mi.Point3f(0, 9, 0), -normal)
    shading = CASES["monte_carlo, occluded"]
    free = np.array(shading.model.trace(points, context, shading).free)
    directions = models.hemisphere(DIRECTIONS, np.array([0, 1.0, 0]))
    blocked = directions[:, 0] * 50 > 1  # the wall is as good as infinite
    assert 0 < blocked.sum() < DIRECTIONS
    for k in range(n):
        np.testing.assert_array_equal([not free[k] >> j & 1 for j in range(DIRECTIONS)], blocked)


def test_what_models_refuse() -> None:
    with pytest.raises(InputError, match="gaussian_shader needs shade_at = surfel"):
        Shading("pixel", "gaussian_shader")
    with pytest.raises(InputError, match="'lambert' is unknown; use split_sum or"):
        Shading(reflectance="lambert")
    with pytest.raises(InputError, match="directions: needs reflectance = monte_carlo"):
        Shading(directions=8)
    with pytest.raises(InputError, match="directions: 65 is not allowed; use a whole number 1 … 64"):
        ShadingOptions(directions=65)
    with pytest.raises(InputError, match="occlusion"):
        Shading("surfel", "gaussian_shader", occlusion=True)
