"""Roughness widened within a pixel: the float64 reference, derivatives, and many samples."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.kernels.device import upload
from mi_refgs.reference import losses as oracle
from mi_refgs.reference.camera import look_at
from mi_refgs.render.antialias import widened
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused

SIZE = (9, 7)
"""Width and height of the maps."""


def camera(size: int, focal: float) -> Camera:
    pose = look_at(np.array([0.0, 0.3, 3.0]), np.zeros(3), up=(0, 1, 0))
    return Camera.from_pose(size, size, -focal, -focal, size / 2, size / 2, pose)


@pytest.fixture
def maps(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Roughness, normals that bend, with an edge, of any length, and alpha with holes, at the border too."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width), np.arange(height))
    bend = np.stack([0.04 * x + 0.02 * y**2, 0.07 * y, np.full(x.shape, 1.0)], -1)
    bend[:, 5:] += [1.5, 0, 0]
    bend[3, 7] = [-3, 0, -1]  # alone: its turns to all sides exceed the bound
    alpha = rng.uniform(0.2, 1, (height, width))
    alpha[[0, 2, 5, 6], [3, 2, 8, 0]] = 0
    alpha[1, 6] = 5e-4
    return rng.uniform(0, 0.6, (height, width)), bend * rng.uniform(0.1, 3, (height, width, 1)), alpha


def found(roughness: mi.Float, normal: np.ndarray, alpha: np.ndarray) -> mi.Float:
    width, height = SIZE
    view = replace(camera(width, 8.0), height=height)
    columns = mi.Vector3f(*(upload(normal[..., i]) for i in range(3)))
    return widened(roughness, columns, upload(alpha), view)


def test_maps_against_the_oracle(maps: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    roughness, normal, alpha = maps
    roughness[2, 4] = 0  # a perfect mirror
    expected = oracle.widened_roughness(roughness, normal, alpha)
    np.testing.assert_allclose(found(upload(roughness), normal, alpha), expected.ravel(), atol=2e-6)
    grown = expected**4 - roughness**4
    assert (grown[alpha < 1e-3] == 0).all() and grown.max() == pytest.approx(0.18)
    assert 1e-4 < np.median(grown[alpha > 1e-3]) < 1e-2
    rough = np.full_like(roughness, 0.99)
    expected = oracle.widened_roughness(rough, normal, alpha)
    np.testing.assert_allclose(found(upload(rough), normal, alpha), expected.ravel(), atol=2e-6)
    assert expected.max() == 1
    flat = np.tile([0.0, 0, 2], (*alpha.shape, 1))
    np.testing.assert_array_equal(found(upload(roughness), flat, alpha), np.float32(roughness).ravel())


@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_derivative_of_the_roughness(
    mode: str, maps: tuple[np.ndarray, np.ndarray, np.ndarray], rng: np.random.Generator
) -> None:
    """Against differences of the float64 reference; normals have none."""
    roughness, normal, alpha = maps
    weight, tangent = rng.normal(size=(2, *roughness.shape))
    step = 1e-6
    slope = (
        oracle.widened_roughness(roughness + step, normal, alpha)
        - oracle.widened_roughness(roughness - step, normal, alpha)
    ) / (2 * step)
    given = upload(roughness)
    dr.enable_grad(given)
    out = found(given, normal, alpha)
    if mode == "forward":
        dr.set_grad(given, upload(tangent))
        np.testing.assert_allclose(dr.forward_to(out), (slope * tangent).ravel(), atol=1e-4)
    else:
        dr.backward(dr.sum(out * upload(weight)))
        np.testing.assert_allclose(dr.grad(given), (slope * weight).ravel(), atol=1e-4)
    turned = mi.Vector3f(*(upload(normal[..., i]) for i in range(3)))
    dr.enable_grad(turned)
    width, height = SIZE
    plain = widened(upload(roughness), turned, upload(alpha), replace(camera(width, 8.0), height=height))
    assert not dr.grad_enabled(plain)


def mirror_ball() -> tuple[Surfels, EnvironmentLight]:
    """A ball of polished metal, and a light of stripes narrower than what a pixel reflects."""
    rng = np.random.default_rng(4)
    direction = rng.normal(size=(4000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    names = ("albedo", "metallic", "roughness", "radiance_sh")
    raw = from_points(direction, direction, rng=rng, attributes=names).to_numpy()
    raw["opacity"][:] = 3.0
    raw["albedo"][:], raw["metallic"][:], raw["roughness"][:] = 3.0, 6.0, -2.5
    stripes = np.tile(np.where(np.arange(128) % 8 < 4, 2.0, 0.1)[None, :, None], (64, 1, 3))
    return Surfels.from_numpy(raw), EnvironmentLight.from_radiance(stripes)


def radiance(made: TrainedScene, samples: int, size: int = 24) -> np.ndarray:
    frame: Frame = made.renderer(aovs=False, samples=samples)(camera(size, 1.2 * size))
    return np.array([*frame.radiance], np.float64)


def test_one_sample_comes_closer_to_many() -> None:
    """A ball that reflects stripes: less error than with pixel centres, and hardly any with many samples."""
    surfels, light = mirror_ball()
    plain = TrainedScene(surfels, light, None, Shading(), 1, 0.0)
    filtered = replace(plain, shading=Shading(antialias=True))
    truth = radiance(plain, 144)
    errors = [np.sqrt(np.mean((radiance(made, 1) - truth) ** 2)) for made in (plain, filtered)]
    assert errors[1] < 0.6 * errors[0]
    assert np.sqrt(np.mean((radiance(filtered, 144) - truth) ** 2)) < 0.1 * errors[0]
    own, other = (made.renderer()(camera(24, 29.0)).maps["roughness"] for made in (plain, filtered))
    np.testing.assert_allclose(own, other, atol=1e-5)  # of one order of additions or another


def test_antialias_requires_deferred_shading() -> None:
    refused(lambda: Shading("surfel", antialias=True), "antialias: needs at = pixel")
