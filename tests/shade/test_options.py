"""Shading options: values and derivatives against the float64 reference and exact integrals; the plugin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.errors import InputError
from mi_refgs.reference import lobe as exact
from mi_refgs.reference.light import radiance_of
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance.split_sum import shade
from tests.helpers import slow
from tests.scenes.integrator import check_derivatives, image, plane_mesh, raw_channels, scene
from tests.scenes.shading_points import points_of

PLAIN = ShadingOptions(diffuse="irradiance")


# ---------------- the settings ----------------


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("diffuse", ("lambert",)),
        ("dominant", (1,)),
        ("directions", (0, 65)),
        ("traced_bounces", (None, -1, True)),
        ("visibility_rays", (0, 2.0, True)),
    ],
)
def test_bad_settings_are_refused(name: str, values: tuple[Any, ...]) -> None:
    for value in values:
        with pytest.raises(InputError, match=name):
            ShadingOptions(**{name: value})


# ---------------- what they are for ----------------


def lit_by(
    map_: np.ndarray, cosines: list[float], roughness: float, options: ShadingOptions, f0: float
) -> np.ndarray:
    """Specular radiance (C,) of a metal under a map, by `shade`; its normal is +x."""
    view = np.array([[c, np.sqrt(1 - c * c), 0] for c in cosines])
    normal, one = np.tile([1.0, 0, 0], (len(view), 1)), np.ones(len(view))
    metal = {"albedo": f0 * np.ones_like(view), "metallic": one, "roughness": roughness * one}
    light = EnvironmentLight.from_radiance(map_).prefilter()
    return (
        shade(points_of({"normal": normal, "view": view, **metal}), light, options)
        .specular.numpy()[0]
        .astype(np.float64)
    )


@pytest.mark.parametrize("roughness", [0.3, 0.9, slow(0.5), slow(0.7)])
def test_the_dominant_direction_comes_closer_to_the_integral(roughness: float) -> None:
    """Under a gradient, split sum against brute force: nearer in sum, and over twice as near where lobes are
    wide."""
    h = 32
    up, around = lobe_matrices.row_angles(h)[:, None, None], lobe_matrices.column_angles(2 * h)[None, :, None]
    map_ = np.tile(2 + np.cos(up) + 0.8 * np.sin(up) * np.sin(around), 3)
    cosines = [0.1, 0.3, 0.5, 0.7, 0.9]
    views = [np.array([c, np.sqrt(1 - c * c), 0]) for c in cosines]
    surface = roughness, np.full(3, 0.8)
    truth = [
        exact.reflected(lambda d: radiance_of(map_, d), np.array([1.0, 0, 0]), view, *surface)[0]
        for view in views
    ]
    mirror, dominant = (
        np.linalg.norm(lit_by(map_, cosines, roughness, options, 0.8) - truth)
        for options in (PLAIN, replace(PLAIN, dominant=True))
    )
    assert dominant < (0.8 if roughness < 0.6 else 0.5) * mirror


def test_properties_of_the_plugin(tmp_path: Path) -> None:
    mesh = plane_mesh(tmp_path)
    options: dict[str, Any] = {"dominant": True, "visibility_rays": 4, "traced_bounces": 2}
    of = scene(mesh=mesh, **options)
    assert {name: getattr(of.integrator().shading, name) for name in options} == options
    assert not scene(mesh=mesh).integrator().shading.chosen()
    plain = image(scene(mesh=mesh))
    for name, value in options.items():
        changed = image(scene(mesh=mesh, **{name: value}))
        assert np.abs(changed - plain).max() > 0.01, name


@pytest.mark.parametrize("rays", [3, slow(1)])
def test_derivatives_of_mi_render(rays: int, tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "dominant": True,
        "diffuse": "irradiance",
        "visibility_rays": rays,
        "traced_bounces": 2,
    }
    check_derivatives(scene(mesh=plane_mesh(tmp_path), **options), "integrator.light")


def test_new_surfels_give_new_materials(tmp_path: Path) -> None:
    """Another number of surfels through the parameters, as a scene that is loaded with them."""
    mesh = plane_mesh(tmp_path)
    of, other = scene(mesh=mesh, traced_bounces=1), raw_channels(40, seed=5)
    params = mi.traverse(of)
    for name, values in other.items():
        params[f"integrator.{name}"] = mi.TensorXf(values)
    params.update()
    np.testing.assert_array_equal(image(of), image(scene(raw=other, mesh=mesh, traced_bounces=1)))
