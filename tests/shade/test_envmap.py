"""Environment light: orientation, activation, the prefilter and its adjoint, lookups and their slopes."""

from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.kernels.device import upload
from mi_refgs.reference import light as reference
from mi_refgs.reference.lobe import lobe_average
from mi_refgs.shade.light import envmap, lobe_matrices, prefilter
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.prefilter_kernels import Kernels
from tests.helpers import AXES, emitted, level_maps, refused, slow, unit, vector, with_grad
from tests.scenes.shading_points import exact_light


def sun_and_gradient(h: int, radiance: float = 500.0) -> np.ndarray:
    θ, φ = lobe_matrices.row_angles(h)[:, None, None], lobe_matrices.column_angles(2 * h)[None, :, None]
    sky = 1 + np.array([0.5, 0.3, -0.2]) * np.cos(θ) + np.array([0.3, -0.2, 0.1]) * np.sin(φ) * np.sin(θ)
    sky[h // 3, h // 4] = radiance
    sky[3, h] = 0.6 * radiance  # close to the pole, where texels are narrow
    return sky


def test_mirror_is_mitsubas_envmap(rng: np.random.Generator, tmp_path: Path) -> None:
    """Of the same image, and of the file that we write: from the six axes, and from everywhere else."""
    radiance, path = rng.uniform(0.1, 2, (16, 32, 3)).astype(np.float32), tmp_path / "new" / "light.exr"
    radiance[0], radiance[-1] = radiance[0, 0], radiance[-1, 0]  # there Mitsuba's azimuth is atan2(±0, ±0)
    light = EnvironmentLight.from_radiance(radiance)
    light.write(path)
    assert [p.name for p in path.parent.iterdir()] == ["light.exr"]
    d = np.concatenate([AXES, unit(rng.normal(size=(2000, 3)))])
    got = light.prefilter().radiance(vector(d)).numpy().T
    for given in ({"bitmap": mi.Bitmap(radiance)}, {"filename": str(path)}):
        np.testing.assert_allclose(got, emitted(mi.load_dict({"type": "envmap"} | given), d), atol=2e-5)
    np.testing.assert_allclose(reference.radiance_of(radiance, d[6:]), got[6:], atol=4e-5)
    again = EnvironmentLight.from_file(path)
    np.testing.assert_allclose(again.radiance().numpy(), light.radiance().numpy(), rtol=1e-6)


def test_bad_input() -> None:
    refused(lambda: EnvironmentLight.from_radiance(np.full((8, 16, 3), np.nan)), "NaN")
    for shape in ((8, 8, 3), (10, 20, 3), (4, 8, 3), (8, 16, 1)):
        refused(partial(EnvironmentLight, dr.zeros(mi.TensorXf, shape)), "shape")


def test_softplus_is_exact_positive_and_finite() -> None:
    x = np.concatenate([np.linspace(-80, 80, 999), [-1e30, 0, 1e30]])
    raw = with_grad(mi.Float(x.astype(np.float32)))
    y = envmap.softplus(raw)
    dr.backward(y)
    x32 = x.astype(np.float32).astype(np.float64)
    np.testing.assert_allclose(y, np.logaddexp(0, x32), rtol=1e-6)
    assert np.all(np.array(y)[:-3] > 0)
    np.testing.assert_allclose(dr.grad(raw), np.exp(-np.logaddexp(0, -x32)), atol=2e-5)


@pytest.mark.parametrize("height", [16, 64])
def test_constant_light_stays_constant(height: int, rng: np.random.Generator) -> None:
    light = EnvironmentLight.constant(2.5, height).prefilter()
    for level in level_maps(light):
        np.testing.assert_allclose(level, 2.5, rtol=1e-5)
    d, r = vector(unit(rng.normal(size=(300, 3)))), mi.Float(rng.uniform(0, 1, 300).astype(np.float32))
    for value in (light.specular(d, r), light.irradiance(d), light.radiance(d)):
        np.testing.assert_allclose(value.numpy(), 2.5, rtol=1e-5)


@pytest.mark.parametrize("levels", [(2, 5), slow((0, 1, 3, 4, 6))])
def test_levels_against_brute_force(levels: tuple[int, ...]) -> None:
    """At texels around two suns and at the poles, against quadrature of the whole lobe."""
    h = 32
    radiance = sun_and_gradient(h)
    sky = partial(reference.radiance_of, radiance)
    maps = level_maps(EnvironmentLight.from_radiance(radiance).prefilter())[1:]
    for roughness, level in ((lobe_matrices.LEVEL_ROUGHNESS[k], maps[k]) for k in levels):
        rows = len(level)
        i, j = round((h // 3) * (rows - 1) / (h - 1)), int((h // 4 + 0.5) * rows / h)
        texels = [(i, j), (0, 0), (3, rows), (rows - 1, 5)]
        directions = lobe_matrices.map_directions(rows)
        expected = np.array([lobe_average(sky, directions[t], roughness) for t in texels])
        error = np.abs(level[*zip(*texels, strict=True)] - expected).max()
        assert error < 0.012 * level.max(), f"roughness {roughness}: {error / level.max():.4f} of the maximum"


def test_irradiance_is_the_cosine_integral(rng: np.random.Generator) -> None:
    radiance = sun_and_gradient(32, 50)
    step = np.pi / 400
    θ, φ = np.meshgrid((np.arange(400) + 0.5) * step, (np.arange(800) + 0.5) * step, indexing="ij")
    d = np.stack([np.sin(θ) * np.sin(φ), np.cos(θ), -np.sin(θ) * np.cos(φ)], -1).reshape(-1, 3)
    sampled = reference.radiance_of(radiance, d) * (np.sin(θ).ravel() * step**2)[:, None]
    normals = np.concatenate([AXES, unit(rng.normal(size=(10, 3)))])
    expected = np.maximum(normals @ d.T, 0) @ sampled / np.pi
    got = EnvironmentLight.from_radiance(radiance).prefilter().irradiance(vector(normals)).numpy().T
    np.testing.assert_allclose(got, expected, rtol=0.012)


def test_filtering_does_not_turn_light_negative() -> None:
    radiance = np.full((64, 128, 3), 1e-2)
    radiance[20, 30] = 1e4
    levels = level_maps(EnvironmentLight.from_radiance(radiance).prefilter())
    assert min(level.min() for level in levels) > 0.008


def test_finer_maps_are_averaged(rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    """With levels capped at 16 rows a map of 64 is filtered like its own average."""
    monkeypatch.setattr(lobe_matrices, "LEVEL_MAX_HEIGHT", (16,) * 7)
    monkeypatch.setattr(prefilter, "operator", prefilter.operator.__wrapped__)
    fine = lobe_matrices.resample(rng.uniform(0, 1, (8, 16, 3)), 64)
    lights = (EnvironmentLight.from_radiance(x).prefilter() for x in (fine, lobe_matrices.resample(fine, 16)))
    for a, b in list(zip(*map(level_maps, lights), strict=True))[1:]:
        np.testing.assert_allclose(a, b, atol=3e-3)


@pytest.mark.parametrize("height", [8, 12, 64])
def test_prefilter_of_a_gpu_is_that_of_the_host(height: int, rng: np.random.Generator) -> None:
    op = prefilter.operator(mi.variant(), height)
    kernels = Kernels(height, op.shapes, op.matrix, op.texels)
    radiance = rng.uniform(size=(height, 2 * height, 3)).astype(np.float32)
    δ = rng.normal(size=(op.texels, 4)).astype(np.float32)
    levels = kernels.apply(upload(radiance)).numpy().reshape(δ.shape)
    np.testing.assert_allclose(levels, op.apply(radiance), atol=4e-6)
    δradiance = kernels.apply_transposed(upload(δ)).numpy().reshape(radiance.shape)
    np.testing.assert_allclose(δradiance, op.apply_transposed(δ), atol=1e-5)


@pytest.mark.parametrize("height", [8, 12, 64])
def test_prefilter_adjoint_and_tangent(height: int, rng: np.random.Generator) -> None:
    """⟨y, P x⟩ = ⟨Pᵀ y, x⟩ with every entry of Pᵀ seen, and the tangent of a linear operator is itself."""
    op = prefilter.operator(mi.variant(), height)
    x = rng.normal(size=6 * height**2).astype(np.float32)
    δ = rng.normal(size=4 * op.texels).astype(np.float32)
    δ[3::4] = 0
    radiance = with_grad(mi.TensorXf(x, (height, 2 * height, 3)))
    _, levels = prefilter.prefilter(radiance)
    primal = np.array(levels, np.float64)
    dr.backward(dr.dot(levels, mi.Float(δ)))
    adjoint = dr.grad(radiance).numpy().ravel().astype(np.float64)
    assert abs(primal @ δ - adjoint @ x) < 1e-5 * np.linalg.norm(adjoint) * np.linalg.norm(x)
    for k in rng.integers(0, len(x), 5):  # single texels: a column of P against an entry of Pᵀ y
        e = np.zeros(len(x), np.float32)
        e[k] = 1
        column = op.apply(e.reshape(radiance.shape)).ravel().astype(np.float64)
        assert abs(column @ δ - adjoint[k]) < 2e-5 * np.abs(adjoint).max()

    step = mi.TensorXf(x[::-1].copy(), radiance.shape)
    _, levels = prefilter.prefilter(with_grad(mi.TensorXf(x, radiance.shape), step))
    tangent = dr.forward_to(levels)
    np.testing.assert_allclose(tangent, op.apply(x[::-1].reshape(radiance.shape)).ravel(), atol=1e-6)


def test_specular_against_the_oracle(rng: np.random.Generator) -> None:
    light = EnvironmentLight.from_radiance(rng.uniform(0.1, 3, (32, 64, 3))).prefilter()
    exact, every = exact_light(light), lobe_matrices.LEVEL_ROUGHNESS
    d, r = unit(rng.normal(size=(400, 3))), np.concatenate([rng.uniform(0, 1, 390), [0, 1, *every, 0.05]])
    got = light.specular(vector(d), mi.Float(r.astype(np.float32))).numpy().T
    np.testing.assert_allclose(got, exact.look_up(*reference.specular(exact, d, r)), atol=1e-4)
    expected = exact.look_up(*reference.irradiance(exact, d))
    np.testing.assert_allclose(light.irradiance(vector(d)).numpy().T, expected, atol=1e-4)
