"""Derivatives of mi.render with the `refgs` plugin, in both modes, against its central differences."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from tests.helpers import refused, slow
from tests.scenes.integrator import (
    COUNT,
    HEIGHT,
    WIDTH,
    check_derivatives,
    image,
    lit_scene,
    raw_channels,
    scene,
    sky,
)


@pytest.mark.parametrize("key", ["position", "light", slow("opacity"), slow("albedo")])
def test_derivatives_with_irradiance_and_supersampling(key: str) -> None:
    of = scene(diffuse="irradiance", aovs="nn:normal,d:depth,a:albedo")
    check_derivatives(of, f"integrator.{key}", spp=4)


@pytest.mark.parametrize("columns", [64, 48], ids=["as it is", "resampled"])
def test_the_scale_of_an_environment_has_a_derivative(columns: int, tmp_path: Path) -> None:
    """Images of metals are linear in the scale, in both modes."""
    mi.Bitmap(sky()[:, :columns]).write(str(tmp_path / "sky.exr"))
    metal = raw_channels() | {"metallic": np.full((COUNT, 1), 30.0)}
    of = lit_scene({"type": "envmap", "filename": str(tmp_path / "sky.exr")}, raw=metal)
    params = mi.traverse(of)
    expected = image(of)
    scale = mi.Float(1)
    dr.enable_grad(scale)
    params["sky.scale"] = scale
    params.update()
    dr.backward(dr.sum(mi.render(of, params), axis=None))
    np.testing.assert_allclose(dr.grad(scale)[0], expected.sum(), rtol=1e-4)
    dr.set_grad(scale, 1)
    tangent = dr.forward_to(mi.render(of, params))
    np.testing.assert_allclose(tangent.numpy(), expected, rtol=1e-4, atol=1e-5)


def test_resampled_environments_refuse_derivatives(tmp_path: Path) -> None:
    mi.Bitmap(sky()[:, :48]).write(str(tmp_path / "odd.exr"))  # 32 x 48
    of = lit_scene({"type": "envmap", "filename": str(tmp_path / "odd.exr")})
    assert image(of).max() > 0.1
    params = mi.traverse(of)
    leaf = mi.TensorXf(params["sky.data"])
    dr.enable_grad(leaf)
    params["sky.data"] = leaf
    params.update()
    loss = dr.sum(mi.render(of, params), axis=None)
    refused(lambda: dr.backward(loss), "has no derivative")


def test_gradients_reach_what_a_parameter_is_made_from() -> None:
    """θ → params → image → loss, as in Mitsuba's tutorials; and an optimiser's step lowers the loss."""
    of = scene()
    params = mi.traverse(of)
    target = mi.render(of) * 0.5
    optimizer = mi.ad.Adam(lr=0.05)
    optimizer["gain"] = mi.Float(1)
    base = mi.TensorXf(params["integrator.radiance_sh"])
    losses = []
    for _ in range(4):
        params["integrator.radiance_sh"] = base * optimizer["gain"]
        params.update()
        loss = dr.mean(dr.square(mi.render(of, params) - target), axis=None)
        dr.backward(loss)
        assert abs(dr.grad(optimizer["gain"])[0]) > 0
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < losses[0] and not dr.grad_enabled(mi.render(of))


def test_a_parameter_that_changes_nothing_has_tangent_zero() -> None:
    """Forward mode, as reverse mode gives gradient zero."""
    of = scene(reflectance="radiance")
    params = mi.traverse(of)
    leaf = mi.TensorXf(params["integrator.albedo"])
    dr.enable_grad(leaf)
    params["integrator.albedo"] = leaf
    params.update()
    image = mi.render(of, params)
    dr.set_grad(leaf, dr.ones(mi.TensorXf, leaf.shape))
    assert not np.any(dr.forward_to(image).numpy())


@pytest.mark.parametrize(
    ("key", "derived", "most"),
    [("position", False, WIDTH * HEIGHT // 3), ("light", True, None), ("albedo", False, None)],
)
def test_tangents_add_up_over_losses(
    key: str, derived: bool, most: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forward mode, as reverse mode, with images and other losses on a parameter, in any order."""
    if most is not None:
        monkeypatch.setattr("mi_refgs.plugins.film.DERIVATIVE_SAMPLES", most)
    of = scene(occlusion=False)
    params = mi.traverse(of)
    base = mi.TensorXf(params[f"integrator.{key}"])

    def weighed(name: str, leaf: mi.TensorXf) -> mi.Float:
        if name == "image":
            return dr.mean(mi.render(of, params), axis=None).array
        used = leaf if name == "leaf" else params[f"integrator.{key}"]
        return dr.mean(dr.square(used.array))

    def tangent(*names: str) -> float:
        leaf = mi.TensorXf(base)
        dr.enable_grad(leaf)
        dr.set_grad(leaf, dr.ones(mi.TensorXf, leaf.shape))
        params[f"integrator.{key}"] = 2 * leaf if derived else leaf
        params.update()
        return float(dr.forward_to(sum((weighed(name, leaf) for name in names), mi.Float(0)))[0])

    alone = {name: tangent(name) for name in ("image", "leaf", "parameter")}
    for names in (("parameter", "image", "leaf"), ("image", "parameter"), ("image", "image")):
        expected = sum(alone[name] for name in names)
        assert tangent(*names) == pytest.approx(expected, rel=1e-4, abs=1e-6), names
    assert alone["image"] != 0
