"""Rays of the GGX lobe: their distribution, and the visibility that they find."""

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.reference import lobe as exact
from mi_refgs.shade import brdf
from mi_refgs.shade.ggx_sampling import Lobe, lobe_point, lobe_turn
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from tests.helpers import slow, unit, vector
from tests.scenes.corner import floor_points, mirrored, seen, wall_blocks


def test_points_repeat_differ_between_pixels_and_are_even() -> None:
    """The mean of a smooth function over k points: error of a lattice, 1/k and not 1/√k, for every pixel."""

    def points(count: int) -> np.ndarray:
        lane = dr.arange(mi.UInt32, 200 * count)
        u, v = lobe_point(lobe_turn(lane // count), lane % count, dr.opaque(mi.UInt32, count))
        return np.stack([np.array(u), np.array(v)]).reshape(2, 200, count).astype(np.float64)

    np.testing.assert_array_equal(points(8), points(8))
    assert len(np.unique(points(8)[1, :, 3])) > 190
    for count, bound in ((4, 0.3), (16, 0.08), (64, 0.02), (256, 0.005)):
        u, v = points(count)
        assert min(u.min(), v.min()) >= 0 and max(u.max(), v.max()) < 1
        assert np.abs((u * np.cos(2 * np.pi * v) ** 2).mean(1) - 0.25).max() < bound, count


@pytest.mark.parametrize("roughness", [0.05, 0.6, slow(0.3), slow(1.0)])
def test_weights_add_up_to_the_table(roughness: float) -> None:
    """Σ weight / k is F0 A + B, and Σ weight direction / k the quadrature's: density, shadowing, Fresnel."""
    cosine, f0, count = np.array([0.05, 0.2, 0.5, 0.8, 1.0]), 0.3, 4096
    normal = unit(np.array([[0.3, -0.5, 0.7]]))[0]
    view = np.stack([np.sqrt(1 - cosine**2), 0 * cosine, cosine], 1) @ exact.frame(normal)
    normals, views = (vector(np.repeat(x, count, 0)) for x in (np.tile(normal, (5, 1)), view))
    lobe = Lobe.of(normals, views, dr.opaque(mi.Float, roughness, 5 * count), mi.Color3f(f0))
    unturned = replace(lobe, turn=mi.UInt32(0))
    direction, weight = unturned.sample(dr.arange(mi.UInt32, 5 * count) % count, mi.UInt32(count))
    weighted = np.concatenate([np.array(weight)[None], np.array(weight) * direction.numpy()])
    total, *mean = weighted.astype(np.float64).reshape(4, 5, count).sum(2)
    mean = np.stack(mean).T
    a, b = brdf.split_sum(mi.Float(cosine.astype(np.float32)), mi.Float(roughness))
    np.testing.assert_allclose(total / count, np.array(f0 * a + b), atol=2e-3)
    for k in range(5):
        nodes, v_h, share = exact.lobe_nodes(normal, unit(view[k]), roughness, 400, 400)
        expected = (share * exact.schlick(v_h, np.array([f0]))[:, 0]) @ nodes
        np.testing.assert_allclose(mean[k] / count, expected, atol=3e-3)


def test_limits_of_the_lobe() -> None:
    """Roughness 0 is the mirror, with Schlick's weight; beyond 1 it is 1; views from below graze."""
    rng = np.random.default_rng(9)
    normal = unit(rng.normal(size=(60, 3)))
    across = unit(np.cross(normal, rng.normal(size=(60, 3))))
    height = np.repeat([0.0, -1.0, -0.3, 1.0, 0.2, 0.7], 10)[:, None]
    view = height * normal + np.sqrt(1 - height**2) * across

    def sample(roughness: float) -> tuple[np.ndarray, np.ndarray]:
        lobe = Lobe.of(vector(normal), vector(view), dr.opaque(mi.Float, roughness, 60), mi.Color3f(0.3))
        direction, weight = lobe.sample(mi.UInt32(5), mi.UInt32(8))
        return direction.numpy().T, np.array(weight)

    direction, weight = sample(0.0)
    mirror, above = 2 * height * normal - view, height[:, 0] > 0
    np.testing.assert_allclose(direction[above], mirror[above], atol=1e-5)
    np.testing.assert_allclose(weight[above], 0.3 + 0.7 * (1 - height[above, 0]) ** 5, rtol=1e-4)
    for roughness in (0.0, 0.01, 0.5, 1.0):
        direction, weight = sample(roughness)
        np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1, atol=1e-5)
        assert np.isfinite(weight).all() and (weight >= 0).all() and (weight <= 1 + 1e-5).all()
        up = weight > 0
        assert ((direction * normal).sum(1)[up] > 0).all() and up.mean() > 0.3
    np.testing.assert_array_equal(sample(7.0)[0], sample(1.0)[0])


def true_fraction(place: np.ndarray, points: ShadingPoints, roughness: float, f0: float) -> np.ndarray:
    def fraction(p: np.ndarray, v: np.ndarray) -> Any:
        seen = np.array([0, 1.0, 0]), unit(v), roughness, f0, 160
        return exact.traced_fraction(lambda d: (~wall_blocks(p, d)[0])[:, None].astype(float), *seen)

    return np.array([*map(fraction, place, points.view.numpy().T.astype(np.float64))])


@pytest.mark.parametrize("roughness", [0.2, 0.8, slow(0.5)])
def test_many_rays_converge_to_the_traced_fraction(roughness: float) -> None:
    """Analytic floor and wall: the error falls as rays are added, and the mirror ray is far off."""
    place, points = floor_points(roughness)
    truth = true_fraction(place, points, roughness, float(np.mean([0.8, 0.7, 0.6])))
    assert 0.05 < truth.mean() < 0.95
    error = {}
    for rays in (1, 4, 16, 64, 1024):
        visibility = np.array(seen(points, place, ShadingOptions(visibility_rays=rays)).visibility)
        error[rays] = float(np.sqrt(np.mean((visibility - truth) ** 2)))
    assert error[4] < 0.7 * error[1] and error[16] < 0.6 * error[4] and error[64] < 0.6 * error[16]
    assert error[1024] < 5e-3


def test_one_ray_is_the_mirror_ray() -> None:
    place, points = floor_points(0.5)
    np.testing.assert_array_equal(
        np.array(seen(points, place, ShadingOptions()).visibility),
        ~np.array([wall_blocks(p, r)[0][0] for p, r in zip(place, mirrored(place), strict=True)]),
    )
