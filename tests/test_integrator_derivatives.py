"""Derivatives of mi.render with the `refgs` plugin, in both modes, against its central differences."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from integrator_scenes import (
    image,
    integrator,
    plane_mesh,
    raw_channels,
    refused,
    scene,
    sensor,
    sky,
)

from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.splat import footprint
from mi_refgs.surfels.table import CHANNELS

STEPS = (5e-3, 5e-4, 1e-4)
"""The order of surfels and the kinks of lookups spoil differences over large steps, rounding over small."""
TANGENT_TOLERANCE = 1e-2  # relative L2 at the best step; observed 4e-5 … 7e-3


@pytest.fixture
def smooth(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the declared step at α = 1/255, differences of the whole renderer have a meaning."""
    monkeypatch.setattr(footprint, "ALPHA_MIN", 1e-8)


def check_derivatives(of: mi.Scene, key: str, spp: int = 1) -> None:
    """Forward mode against central differences of mi.render, and reverse mode against forward mode."""
    rng = np.random.default_rng(3)
    params = mi.traverse(of)
    base = params[key].numpy().copy()  # a view: the parameter is about to be overwritten in place
    v = (rng.uniform(0.5, 1, base.shape) * rng.choice([-1, 1], base.shape)).astype(np.float32)

    def at(t: object) -> mi.TensorXf:
        params[key] = mi.TensorXf(base) + t * mi.TensorXf(v)
        params.update()
        return mi.render(of, params, spp=spp)

    t = mi.Float(0)
    dr.enable_grad(t)
    rendered = at(t)
    dr.set_grad(t, 1)
    tangent = dr.forward_to(rendered).numpy()
    errors = []
    for step in STEPS:
        difference = (at(mi.Float(step)).numpy() - at(mi.Float(-step)).numpy()) / (2 * step)
        errors.append(np.linalg.norm(tangent - difference) / np.linalg.norm(difference))
    assert np.linalg.norm(difference) > 1e-3, f"{key}: no influence on the image"
    assert min(errors) < TANGENT_TOLERANCE, f"{key}: {min(errors):.1e} from central differences"

    leaf = mi.TensorXf(base)
    dr.enable_grad(leaf)
    params[key] = leaf
    params.update()
    weight = rng.normal(size=tangent.shape).astype(np.float32)
    dr.backward(dr.sum(mi.render(of, params, spp=spp) * mi.TensorXf(weight), axis=None))
    reverse, forward = np.sum(dr.grad(leaf).numpy() * v), np.sum(weight * tangent)
    assert abs(reverse - forward) < 1e-5 * np.linalg.norm(weight) * np.linalg.norm(tangent)


@pytest.mark.parametrize("key", [*(name for name in CHANNELS if name != "indirect_sh"), "light"])
def test_derivatives_of_every_channel(key: str, smooth: None) -> None:
    check_derivatives(scene(), f"integrator.{key}")


@pytest.mark.parametrize("key", ["position", "albedo", "light"])
def test_derivatives_with_irradiance_and_supersampling(key: str, smooth: None) -> None:
    of = scene(diffuse="irradiance", aovs="nn:normal,d:depth,a:albedo")
    check_derivatives(of, f"integrator.{key}", spp=4)


@pytest.mark.parametrize("key", ["rotation", "metallic", "light"])
def test_derivatives_when_shading_at_surfels(key: str, smooth: None) -> None:
    check_derivatives(scene(shade_at="surfel"), f"integrator.{key}")


@pytest.mark.parametrize("key", ["indirect_sh", "opacity"])
def test_derivatives_with_occlusion(key: str, smooth: None, tmp_path: Path) -> None:
    of = scene(mesh=plane_mesh(tmp_path))
    check_derivatives(of, f"integrator.{key}")


def test_indirect_light_trains_from_zero(tmp_path: Path) -> None:
    raw = raw_channels()
    raw["indirect_sh"] *= 0
    of = scene(raw=raw, mesh=plane_mesh(tmp_path))
    params = mi.traverse(of)
    leaf = params["integrator.indirect_sh"]
    dr.enable_grad(leaf)
    dr.backward(dr.sum(mi.render(of, params), axis=None))
    assert np.abs(dr.grad(leaf).numpy()).max() > 1e-3


def test_derivatives_of_the_scenes_environment(tmp_path: Path) -> None:
    EnvironmentLight.from_radiance(sky()).write(tmp_path / "sky.exr")
    channels = integrator()
    del channels["light"]
    emitter = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    of = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
    check_derivatives(of, "sky.data")
    # Reflections are linear in the scale.
    params = mi.traverse(of)
    scale = mi.Float(1)
    dr.enable_grad(scale)
    params["sky.scale"] = scale
    params.update()
    dr.backward(dr.sum(mi.render(of, params), axis=None))
    np.testing.assert_allclose(dr.grad(scale)[0], image(scene(terms="specular")).sum(), rtol=1e-4)


def test_derivatives_of_a_constant_environment() -> None:
    channels = integrator(terms="specular")
    del channels["light"]
    sky = {"type": "constant", "radiance": {"type": "rgb", "value": [1.0, 1.0, 1.0]}}
    of = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": sky})
    params = mi.traverse(of)
    colour = mi.Color3f(1, 1, 1)
    dr.enable_grad(colour)
    params["sky.radiance.value"] = colour
    params.update()
    rendered = mi.render(of, params)
    dr.backward(dr.sum(rendered, axis=None))
    np.testing.assert_allclose(np.ravel(dr.grad(colour)), rendered.numpy().sum((0, 1)), rtol=1e-4)


def test_resampled_environments_refuse_derivatives(tmp_path: Path) -> None:
    mi.Bitmap(sky()[:, :48]).write(str(tmp_path / "odd.exr"))  # 32 x 48
    channels = integrator()
    del channels["light"]
    emitter = {"type": "envmap", "filename": str(tmp_path / "odd.exr")}
    of = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
    assert image(of).max() > 0.1
    params = mi.traverse(of)
    leaf = mi.TensorXf(params["sky.data"])
    dr.enable_grad(leaf)
    params["sky.data"] = leaf
    params.update()
    loss = dr.sum(mi.render(of, params), axis=None)
    refused("cannot be differentiated", lambda: dr.backward(loss))


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
    assert losses[-1] < losses[0]
    assert not dr.grad_enabled(mi.render(of))
