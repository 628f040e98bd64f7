"""Surfels to image: both orders against float64, the side of normals, SH, bounds of opacity."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.reference import splat as oracle
from mi_refgs.reference.camera import look_at
from mi_refgs.reference.models import sh_basis
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels
from tests.scenes import splats
from tests.scenes.integrator import HEIGHT, WIDTH, raw_channels
from tests.scenes.splats import seen_from

COLOUR = Shading(at="surfel", reflectance="radiance")


def discs(**channels: Any) -> Surfels:
    return Surfels.from_numpy(splats.discs(**channels))


def channel(frame: Frame, name: str) -> np.ndarray:
    return np.array(getattr(frame, name), dtype=np.float64).T


@pytest.mark.parametrize(("at", "model"), [("pixel", "split_sum"), ("surfel", "monte_carlo")])
def test_light_of_a_turntable_turns_with_the_camera(at: Any, model: str) -> None:
    """A second camera sees the light rotated by what rotates the first camera into it."""
    first, second = (look_at(np.array(origin), np.zeros(3)) for origin in ([3.0, 1, 2], [-2.0, 2, -1]))
    direction, turn = map_directions(32), second[:3, :3] @ first[:3, :3].T
    surfels = Surfels.from_numpy(raw_channels())
    shading = Shading(at=at, reflectance=model, diffuse="irradiance")
    camera = Camera.from_pose(WIDTH, HEIGHT, -19.0, -20.0, 8.3, 5.6, second)

    def image_of(radiance: np.ndarray, **turntable: Any) -> np.ndarray:
        light = shading.light_of(EnvironmentLight.from_radiance(0.6 + 0.3 * radiance))
        return channel(render(SurfelScene(surfels, shading, light, **turntable), camera), "radiance")

    axes = mi.TensorXf(first[:3, :3].astype(np.float32))
    expected = image_of(direction @ turn)  # L(Rᵀ d)
    np.testing.assert_allclose(image_of(direction, turntable=axes), expected, atol=4e-3)
    assert np.abs(image_of(direction) - expected).max() > 0.05


@pytest.mark.parametrize("degrees", [0, 50, 80, 100, 115, 130, 180])
def test_normals_are_turned_to_the_camera_unless_they_only_lean_away(degrees: float) -> None:
    """A surfel turned about +y; up to 14° (a cosine of ¼) behind the silhouette its normal stays."""
    half = np.radians(degrees) / 2
    turned = discs(rotation=np.array([[0, np.sin(half), 0, np.cos(half)]]))
    frame = render(SurfelScene(turned, COLOUR), seen_from(0, 0, 4.0), Request(("normal",)))
    normal = channel(frame, "normal")[0]
    outward = np.array([np.sin(2 * half), 0, np.cos(2 * half)])
    expected = -outward if outward[2] < -0.25 else outward
    assert np.linalg.norm(normal) > 0.1
    np.testing.assert_allclose(normal / np.linalg.norm(normal), expected, atol=1e-5)


@pytest.mark.parametrize("degree", [0, 1, 2, 3, None])
def test_colour_of_harmonics_up_to_a_degree(degree: int | None, rng: np.random.Generator) -> None:
    coefficients = 0.3 * rng.normal(size=(1, 48))
    origin = np.array([1.0, -2.0, 3.0])
    camera = seen_from(*origin)
    frame = render(SurfelScene(discs(radiance_sh=coefficients), COLOUR), camera, Request(sh_degree=degree))
    basis = sh_basis(-origin / np.linalg.norm(origin), 3)
    basis[(4 if degree is None else degree + 1) ** 2 :] = 0
    expected = np.maximum(0.5 + basis @ coefficients.reshape(16, 3), 0)
    found = channel(frame, "radiance")[0] / channel(frame, "alpha")[0]
    np.testing.assert_allclose(found, expected, atol=1e-5)


def test_opacity_and_the_size_on_screen_have_their_bounds() -> None:
    """An opaque surfel covers 0.99; one far smaller than a pixel is a Gaussian of the pixel's variance."""
    camera = seen_from(0, 0, 4.0, size=4)
    large, small = (discs(scale=np.full((1, 2), np.log(scale))) for scale in (10.0, 1e-4))
    assert channel(render(SurfelScene(large, COLOUR), camera), "alpha") == pytest.approx(0.99)
    alpha = channel(render(SurfelScene(small, COLOUR), camera), "alpha").reshape(4, 4)
    # The four pixels in the middle have their centres half a pixel from it along each axis.
    assert alpha[1:3, 1:3] == pytest.approx(np.exp(-0.5 * 12 * 0.5))
    assert np.count_nonzero(alpha) == 4


def test_layers_show_down_to_the_least_transmittance() -> None:
    """Each layer halves the light; the 13th is the last before 1e-4."""
    layers = discs(opacity=np.zeros((20, 1)), scale=np.full((20, 2), np.log(100.0)))
    alpha = channel(render(SurfelScene(layers, COLOUR), seen_from(0, 0, 4.0)), "alpha")
    assert 1 - alpha == pytest.approx(2.0**-13, rel=1e-2)


def test_samples_before_the_near_plane_are_cut() -> None:
    """A disc crosses the plane, though its centre lies beyond."""
    leaning = discs(rotation=np.array([[np.sin(0.5), 0, 0, np.cos(0.5)]]), scale=np.full((1, 2), np.log(2.0)))
    raw = {name: values.astype(np.float64) for name, values in leaning.to_numpy().items()}
    covered = []
    for near in (0.01, 3.5):
        camera = replace(seen_from(0, 0, 4.0, size=12), near=dr.opaque(mi.Float, near))
        pose = look_at(np.array([0, 0, 4.0]), np.zeros(3), up=(0, 1, 0))
        view = oracle.PinholeCamera(12, 12, -8.0, -8.0, 6, 6, pose, near)
        expected = oracle.splat(raw, np.zeros((1, 0)), view)
        alpha = channel(render(SurfelScene(leaning, COLOUR), camera), "alpha").reshape(12, 12)
        np.testing.assert_allclose(alpha[~expected.band], expected.alpha[~expected.band], atol=1e-5)
        covered.append(np.count_nonzero(alpha))
    assert 0.2 * covered[0] < covered[1] < 0.8 * covered[0]


def test_normals_are_blended_only_where_something_needs_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forward shading blends none: three features fewer, and the same radiance."""
    from mi_refgs import splat

    composite = Mock(wraps=splat.composite)
    monkeypatch.setattr(splat, "composite", composite)
    surfels = discs(radiance_sh=np.full((3, 3), 0.2))
    camera = seen_from(0, 0, 4.0, size=12)
    frames = [render(SurfelScene(surfels, COLOUR), camera, Request(aovs)) for aovs in (("normal",), ())]
    assert [len(call.args[1]) for call in composite.call_args_list] == [6, 3] and frames[1].normal is None
    np.testing.assert_array_equal(*(frame.radiance.numpy() for frame in frames))
