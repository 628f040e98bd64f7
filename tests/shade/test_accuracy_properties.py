"""Shading options as properties of the `refgs` plugin."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from tests.scenes.integrator import check_derivatives, image, integrator, plane_mesh, raw_channels, scene


def test_properties_of_the_plugin(tmp_path: Path) -> None:
    mesh = plane_mesh(tmp_path)
    options: dict[str, Any] = {
        "dominant": True,
        "multiscatter": True,
        "visibility_rays": 4,
        "traced_bounces": 2,
    }
    of = scene(mesh=mesh, **options)
    assert {name: getattr(of.integrator().shading, name) for name in options} == options
    assert not scene(mesh=mesh).integrator().shading.chosen()
    plain = image(scene(mesh=mesh, terms="specular,indirect"))
    for name, value in options.items():
        assert (
            np.abs(image(scene(mesh=mesh, terms="specular,indirect", **{name: value})) - plain).max() > 0.01
        ), name


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"visibility_rays": 0}, "visibility_rays"),
        ({"visibility_rays": 1.5}, "visibility_rays"),
        ({"traced_bounces": -1}, "traced_bounces"),
        ({"traced_bounces": True}, "traced_bounces"),
        ({"visibility_rays": 4}, "trace a `mesh`"),
        ({"traced_bounces": 1}, "trace a `mesh`"),
        ({"dominant": "yes"}, "dominant"),
        ({"multiscatter": True, "reflectance": "radiance"}, "split_sum"),
    ],
)
def test_bad_properties_are_refused(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(Exception, match=words):
        mi.load_dict(integrator(**changes))


@pytest.mark.parametrize("rays", [1, 3])
def test_derivatives_of_mi_render(rays: int, tmp_path: Path) -> None:
    options: dict[str, Any] = {
        "dominant": True,
        "multiscatter": True,
        "visibility_rays": rays,
        "traced_bounces": 2,
    }
    check_derivatives(scene(mesh=plane_mesh(tmp_path), diffuse="irradiance", **options), "integrator.light")


def test_new_surfels_give_new_materials(tmp_path: Path) -> None:
    """Another number of surfels through the parameters, as a scene that is loaded with them."""
    mesh = plane_mesh(tmp_path)
    of, other = scene(mesh=mesh, traced_bounces=1), raw_channels(40, seed=5)
    params = mi.traverse(of)
    for name, values in other.items():
        params[f"integrator.{name}"] = mi.TensorXf(values)
    params.update()
    np.testing.assert_array_equal(image(of), image(scene(raw=other, mesh=mesh, traced_bounces=1)))
