"""The BSDF: against its formula, quadrature and the split-sum table; its samples, derivatives and faces."""

from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.reference import lobe as reference
from mi_refgs.reference.light import radiance_of
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.helpers import slow, unit, vector, with_grad
from tests.scenes.integrator import sky

ALBEDO = np.array([0.9, 0.5, 0.2])
SPECULAR, DIFFUSE = 0, 1


def bsdf(roughness: Any = 0.4, metallic: Any = 0.3, albedo: Any = ALBEDO) -> Any:
    colour = albedo if isinstance(albedo, float) else {"type": "rgb", "value": [float(x) for x in albedo]}
    return {"type": "refgs_bsdf", "albedo": colour, "metallic": metallic, "roughness": roughness}


def interaction(wi: Any, width: int = 1) -> Any:
    """Surface points seen from the local direction(s) `wi`, (3,) or (N, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, width)
    si.wi = vector(np.broadcast_to(wi, (width, 3)))
    si.uv = mi.Point2f(0.5)
    return si


def seen_at(n_dot_v: float) -> np.ndarray:
    azimuth, sine = 0.7, np.sqrt(1 - n_dot_v**2)
    return np.array([sine * np.cos(azimuth), sine * np.sin(azimuth), n_dot_v])


def above(rng: np.random.Generator, count: int) -> np.ndarray:
    """Directions over the hemisphere, a fifth of them close to the horizon."""
    d = unit(rng.normal(size=(count, 3)))
    d[::5, 2] *= 0.02
    d[:, 2] = np.abs(d[:, 2])
    return unit(d)


def context(component: int | None = None, mask: Any = None) -> Any:
    ctx = mi.BSDFContext()
    if component is not None:
        ctx.component = component
    if mask is not None:
        ctx.type_mask = int(mask)
    return ctx


def mean_weight(of: Any, wi: Any, ctx: Any = None, side: int = 512, arriving: Any = lambda wo: 1) -> Any:
    """Mean of the weights that sampling returns, times what arrives, over a grid of the two numbers."""
    i = dr.arange(mi.UInt32, side * side)
    uv = mi.Point2f((mi.Float(i % side) + 0.5) / side, (mi.Float(i // side) + 0.5) / side)
    choice = mi.Float((np.arange(side * side) * 0.6180339887498949) % 1)
    sampled, weight = of.sample(ctx or context(), interaction(wi, side * side), choice, uv)
    return mi.Color3f(*(dr.mean(c) for c in weight * arriving(sampled.wo)))


@pytest.mark.parametrize(
    ("roughness", "metallic"),
    [(0.03, 0.4), (0.2, 0.0), (0.6, 1.0), (1.0, 0.4), slow(0.03, 1.0), slow(1.0, 0.0)],
)
def test_eval_is_the_formula(rng: np.random.Generator, roughness: float, metallic: float) -> None:
    count = 80
    wi = above(rng, count)
    normals = unit(np.array([0, 0, 1]) + roughness**2 * rng.normal(size=(count, 3)))
    wo = 2 * (wi * normals).sum(1, keepdims=True) * normals - wi
    wo[::2] = unit(rng.normal(size=wo[::2].shape))  # below the surface too
    wi, wo = (d.astype(np.float32).astype(np.float64) for d in (wi, wo))  # both sides get the same numbers
    got = mi.load_dict(bsdf(roughness, metallic)).eval(context(), interaction(wi, count), vector(wo))
    up, pairs = np.array([0, 0, 1.0]), zip(wi, wo[:, None], strict=True)
    expected = np.concatenate([reference.brdf_cosine(ALBEDO, metallic, roughness, up, *d) for d in pairs])
    assert (expected[:, 0] > 0).mean() > 0.5 and (expected == 0).any()
    limit = (5e-3 if roughness < 0.1 else 2e-4) * expected + 1e-6
    # The table's own interpolation, in the diffuse term: up to 0.11 where its first texel ends.
    table = np.where(wi[:, 2:] < 0.01, 0.12, 1e-3)
    limit += table * (1 - metallic) * ALBEDO * np.maximum(wo[:, 2:], 0) / np.pi
    assert np.all(np.abs(np.array(got).T - expected) <= limit)


def test_reciprocity(rng: np.random.Generator) -> None:
    """The specular term is reciprocal; the whole is not, but a path from a light sees what one to it sees."""
    count = 2000
    a, b = above(rng, count), above(rng, count)

    def value(of: Any, ctx: Any, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        return np.array(of.eval(ctx, interaction(wi, count), vector(wo))) / wo[:, 2]

    from_light = context()
    from_light.mode = mi.TransportMode.Importance
    for roughness, metallic in ((0.1, 1.0), (0.4, 0.5), (1.0, 0.0)):
        of = mi.load_dict(bsdf(roughness, metallic))
        forth, back = value(of, context(SPECULAR), a, b), value(of, context(SPECULAR), b, a)
        np.testing.assert_allclose(forth, back, rtol=2e-4)
        whole, transposed = value(of, context(), a, b), value(of, from_light, b, a)
        np.testing.assert_allclose(whole, transposed, rtol=2e-4)
        assert metallic == 1 or np.abs(whole - value(of, context(), b, a)).max() > 0.02


@pytest.mark.parametrize("roughness", [0.01, 0.2, 1.0, slow(0.05), slow(0.6)])
def test_white_furnace_is_the_split_sum(roughness: float) -> None:
    """Under constant light each component reflects what `shade` says, in the mean over its own samples."""
    for n_dot_v in (0.02, 0.1, 0.4, 1.0):
        wi = seen_at(n_dot_v)
        a, b = (x[0] for x in split_sum(mi.Float(n_dot_v), mi.Float(roughness)))
        white = mean_weight(mi.load_dict(bsdf(roughness, 1.0, 1.0)), wi)
        assert abs(white.x[0] - (a + b)) < 2e-3 and white.x[0] <= 1 + 1e-5
        mixed = mi.load_dict(bsdf(roughness, 0.25))
        f0 = 0.04 * 0.75 + 0.25 * ALBEDO
        diffuse = (1 - f0 * a - b) * 0.75 * ALBEDO
        for part, expected in ((SPECULAR, f0 * a + b), (DIFFUSE, diffuse), (None, f0 * a + b + diffuse)):
            np.testing.assert_allclose(np.ravel(mean_weight(mixed, wi, context(part))), expected, atol=2e-3)


@pytest.mark.parametrize(
    ("roughness", "metallic"), [(0.3, 0.5), (1.0, 0.0), slow(0.3, 1.0), slow(0.6, 0.5), slow(1.0, 1.0)]
)
def test_chi_squared(roughness: float, metallic: float) -> None:
    from mitsuba.python.chi2 import BSDFAdapter, ChiSquareTest, SphericalDomain

    for n_dot_v in (1.0, 0.5, 0.1):
        wi = [float(x) for x in seen_at(n_dot_v)]
        sample, pdf = BSDFAdapter("refgs_bsdf", bsdf(roughness, metallic), wi=wi)
        test = ChiSquareTest(SphericalDomain(), sample, pdf, 3, sample_count=1_000_000, ires=16)
        assert test.run(0.01, test_count=27, quiet=True), test.messages


def test_samples_agree_with_eval_and_pdf(rng: np.random.Generator) -> None:
    count = 5000
    of, si = mi.load_dict(bsdf(0.15)), interaction(above(rng, count), count)
    u = mi.Float(rng.uniform(size=count))
    sampled, weight = of.sample(context(), si, u, mi.Point2f(rng.uniform(size=(2, count)).astype(np.float32)))
    value, density = of.eval_pdf(context(), si, sampled.wo)
    valid = np.array(sampled.pdf > 0)
    assert valid.mean() > 0.95
    assert (np.array(weight)[:, ~valid] == 0).all() and ((np.array(sampled.wo)[2] > 0) == valid).all()
    np.testing.assert_allclose(np.array(density)[valid], np.array(sampled.pdf)[valid], rtol=1e-4)
    np.testing.assert_allclose(np.array(weight * sampled.pdf)[:, valid], np.array(value)[:, valid], rtol=1e-4)
    kind, component = np.array(sampled.sampled_type), np.array(sampled.sampled_component)
    for index, flag in ((SPECULAR, mi.BSDFFlags.GlossyReflection), (DIFFUSE, mi.BSDFFlags.DiffuseReflection)):
        assert 0.1 < (component == index).mean() < 0.9
        assert (kind[component == index] == int(flag)).all()
        assert of.flags(index) == flag | mi.BSDFFlags.FrontSide


def test_components_and_masks(rng: np.random.Generator) -> None:
    si, wo = interaction(above(rng, 500), 500), vector(above(rng, 500))
    of = mi.load_dict(bsdf())
    parts = [np.array(of.eval(context(k), si, wo)) for k in (SPECULAR, DIFFUSE)]
    np.testing.assert_allclose(sum(parts), np.array(of.eval(context(), si, wo)), rtol=1e-5)
    flags = (mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection)
    for part, flag in zip(parts, flags, strict=True):
        assert part.max() > 0
        np.testing.assert_array_equal(np.array(of.eval(context(mask=flag), si, wo)), part)
    nothing = context(mask=mi.BSDFFlags.DeltaTransmission)
    _, weight = of.sample(nothing, si, mi.Float(0.5), mi.Point2f(0.2, 0.3))
    for none in (weight, of.eval(nothing, si, wo), of.pdf(nothing, si, wo)):
        assert dr.all(none == 0, axis=None)


def test_reflects_on_one_side_unless_wrapped() -> None:
    front, back = np.array([0.6, 0, 0.8]), np.array([0.6, 0, -0.8])
    one = mi.load_dict(bsdf())
    two = mi.load_dict({"type": "twosided", "bsdf": bsdf()})
    up = one.eval(context(), interaction(front), mi.Vector3f(0, 0, 1))
    assert dr.all(up > 0, axis=None)
    for wo in (1, -1):
        assert dr.all(one.eval(context(), interaction(back), mi.Vector3f(0, 0, wo)) == 0, axis=None)
        assert dr.all(one.pdf(context(), interaction(back), mi.Vector3f(0, 0, wo)) == 0)
    down = two.eval(context(), interaction(back), mi.Vector3f(0, 0, -1))
    np.testing.assert_allclose(np.array(down), np.array(up))
    sampled, weight = one.sample(context(), interaction(back), mi.Float(0.1), mi.Point2f(0.2, 0.3))
    assert dr.all(weight == 0, axis=None) and sampled.pdf[0] == 0


@pytest.mark.parametrize(("roughness", "metallic"), [(0.05, 1.0), (0.2, 0.0), (0.5, 0.5), (1.0, 0.0)])
@pytest.mark.parametrize("degrees", [50, slow(0), slow(80)])
def test_samples_under_a_sky_give_its_integral(degrees: int, roughness: float, metallic: float) -> None:
    """What a path tracer sums up, against quadrature of the formula."""
    normal = unit(np.array([0.3, 0.5, 0.81]))
    frame, radiance = reference.frame(normal), sky()
    wi = np.array([np.sin(np.radians(degrees)), 0, np.cos(np.radians(degrees))])
    light, to_world = EnvironmentLight.from_radiance(radiance).unfiltered(), mi.Matrix3f(frame.T)
    of = mi.load_dict(bsdf(roughness, metallic))
    found = mean_weight(of, wi, side=1024, arriving=lambda wo: light.radiance(to_world @ wo))
    sun = partial(radiance_of, radiance.astype(np.float64))
    expected = reference.reflected_radiance(sun, ALBEDO, metallic, roughness, normal, wi @ frame)
    np.testing.assert_allclose(np.ravel(found), expected, rtol=5e-3)


@pytest.mark.parametrize("roughness", [0.2, 1.0, slow(0.7)])
def test_derivatives_of_sampled_weights(roughness: float) -> None:
    """Those of the weights give those of the reflectance, as samples, densities and the choice have none."""
    n_dot_v, metallic, ε = 0.5, 0.3, 1e-3
    of = mi.load_dict(bsdf(roughness, metallic))
    params = mi.traverse(of)
    values = with_grad([params[f"{name}.value"] for name in ("roughness", "metallic", "albedo")])
    params.update()
    si = interaction(seen_at(n_dot_v))
    sampled, weight = of.sample(context(), si, mi.Float(0.5), mi.Point2f(0.3, 0.6))
    value, density = of.eval_pdf(context(), si, sampled.wo)
    assert dr.grad_enabled(weight) and dr.grad_enabled(value)
    for detached in (sampled.wo, sampled.pdf, density, of.pdf(context(), si, sampled.wo)):
        assert not dr.grad_enabled(detached)
    dr.backward(mean_weight(of, seen_at(n_dot_v)).y)
    got = [dr.grad(value) for value in values]
    a, b = reference.split_sum_entry(n_dot_v, roughness)
    f0 = 0.04 * (1 - metallic) + ALBEDO[1] * metallic
    left, base = 1 - f0 * a - b, (1 - metallic) * ALBEDO[1]  # the reflectance is f0 a + b + left base
    ends = roughness - ε, min(roughness + ε, 1)
    low, high = (np.array(reference.split_sum_entry(n_dot_v, r)) for r in ends)
    slope = (high - low) @ [f0, 1] / (ends[1] - ends[0])
    assert abs(got[0][0] - (1 - base) * slope) < 5e-3
    assert abs(got[1][0] - ((1 - base) * (ALBEDO[1] - 0.04) * a - left * ALBEDO[1])) < 5e-3
    to_albedo = (1 - base) * metallic * a + left * (1 - metallic)
    np.testing.assert_allclose(np.ravel(got[2]), [0, to_albedo, 0], atol=5e-3)


def test_everything_is_finite() -> None:
    """Values and derivatives, at the bounds of the parameters and for directions without a half vector."""
    plane = np.array([[0, 1], [1, 0], [1, 1e-7], [0, 0], [0, -1], [0.6, 0.8], [-1, 1e-30]])
    directions = np.insert(plane, 1, 0, axis=1)
    wi, wo = (d.reshape(-1, 3) for d in np.broadcast_arrays(directions[:, None], directions[None]))
    count = len(wi)
    for roughness, metallic, albedo in ((1e-9, 1.0, 0.0), (1e-9, 0.0, 1.0), (1.0, 1.0, 0.0), (1.0, 0.0, 0.0)):
        of = mi.load_dict(bsdf(roughness, metallic, albedo))
        params = mi.traverse(of)
        inputs = with_grad([params[f"{name}.value"] for name in ("roughness", "metallic", "albedo")])
        params.update()
        si, out = interaction(wi, count), vector(wo)
        dr.enable_grad(si.wi, out)
        value, density = of.eval_pdf(context(), si, out)
        sampled, weight = of.sample(context(), si, mi.Float(0.999), mi.Point2f(0.999, 0.5))
        dr.backward(dr.sum(dr.sum(value + weight)))
        for x in (value, density, sampled.wo, sampled.pdf, weight, *map(dr.grad, (*inputs, si.wi, out))):
            assert np.isfinite(np.array(x)).all()


def test_parameters_and_text() -> None:
    grey = mi.Bitmap(np.full((2, 2, 1), 0.25, np.float32))
    of = mi.load_dict(bsdf(roughness={"type": "bitmap", "bitmap": grey, "raw": True}))
    params = mi.traverse(of)
    for key in ("albedo.value", "metallic.value", "roughness.data"):
        assert params.flags(key) == mi.ParamFlags.Differentiable
    assert "roughness = BitmapTexture[" in repr(of)
    si, wo = interaction(seen_at(0.6)), vector(seen_at(0.8)[None])

    def value(one: Any) -> np.ndarray:
        return np.array(one.eval(context(), si, wo))

    np.testing.assert_allclose(value(of), value(mi.load_dict(bsdf(0.25))), rtol=1e-5)
    params["roughness.data"] = mi.TensorXf(np.full((2, 2, 1), 0.5, np.float32))
    params.update()
    np.testing.assert_allclose(value(of), value(mi.load_dict(bsdf(0.5))), rtol=1e-5)
    expected = reference.diffuse_reflectance(ALBEDO, 0.3, 0.5, 0.6)
    for side in (1, -1):
        si.wi.z *= side
        np.testing.assert_allclose(np.ravel(of.eval_diffuse_reflectance(si)), expected, atol=5e-4)


@pytest.mark.parametrize(
    ("properties", "words"),
    [
        ({"roughness": 0.0}, "refgs_bsdf: roughness: 0.0 is outside (0, 1]"),
        ({"roughness": float("nan")}, "refgs_bsdf: roughness: nan is outside (0, 1]"),
        ({"metallic": -0.1}, "refgs_bsdf: metallic: -0.1 is outside [0, 1]"),
        ({"metallic": {"type": "rgb", "value": 1.0}}, "refgs_bsdf: metallic: [1, 1, 1] is a colour"),
        ({"albedo": {"type": "rgb", "value": [0, 0, 2]}}, "refgs_bsdf: albedo: [0, 0, 2] is outside [0, 1]"),
    ],
)
def test_bad_input(properties: dict, words: str) -> None:
    with pytest.raises(RuntimeError) as info:
        mi.load_dict({"type": "refgs_bsdf"} | properties)
    assert words in str(info.value)
