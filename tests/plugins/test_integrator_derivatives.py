"""Derivatives of mi.render with the `refgs` plugin, in both modes, against its central differences."""

from __future__ import annotations

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.shade.light.envmap import EnvironmentLight
from tests.helpers import refused
from tests.scenes.integrator import (
    image,
    integrator,
    plane_mesh,
    raw_channels,
    scene,
    sensor,
    sky,
)

STEPS = (2e-3, 2e-4)
"""Widths of differences; the better one counts: rounding spoils the small one, curvature the large one."""
JUMP = 0.1
"""Part of the root mean square of the differences: where the two sides differ by more, a surfel has crossed
the cut at α = 1/255, another surfel of its tile, or the kink of a lookup: there is no derivative."""
MAX_LEFT_OUT = 0.2
"""Share of the seen pixels in which that may happen; observed up to 2 % at the better step."""
TANGENT_TOLERANCE = 5e-3  # relative L2; observed 8e-5 … 3e-3


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
        before, middle, after = (at(mi.Float(t)).numpy().astype(np.float64) for t in (-step, 0, step))
        left, right = (middle - before) / step, (after - middle) / step
        difference, seen = (left + right) / 2, np.any(middle != 0, axis=2)
        typical = np.sqrt(np.mean(difference[seen] ** 2))
        assert typical > 1e-3, f"{key}: no influence on the image"
        smooth = np.all(np.abs(right - left) < JUMP * (typical + np.abs(difference)), axis=2)
        if np.mean(~smooth[seen]) <= MAX_LEFT_OUT:
            error = np.linalg.norm((tangent - difference)[smooth])
            errors.append(error / np.linalg.norm(difference[smooth]))
    assert errors, f"{key}: too many jumps at every step"
    assert min(errors) < TANGENT_TOLERANCE, f"{key}: {min(errors):.1e} from central differences"

    leaf = mi.TensorXf(base)
    dr.enable_grad(leaf)
    params[key] = leaf
    params.update()
    weight = rng.normal(size=tangent.shape).astype(np.float32)
    dr.backward(dr.sum(mi.render(of, params, spp=spp) * mi.TensorXf(weight), axis=None))
    reverse, forward = np.sum(dr.grad(leaf).numpy() * v), np.sum(weight * tangent)
    assert abs(reverse - forward) < 1e-5 * np.linalg.norm(weight) * np.linalg.norm(tangent)


@pytest.mark.parametrize("key", [*(name for name in raw_channels() if name != "indirect_sh"), "light"])
def test_derivatives_of_every_channel(key: str) -> None:
    check_derivatives(scene(), f"integrator.{key}")


@pytest.mark.parametrize("key", ["position", "opacity", "albedo", "light"])
def test_derivatives_with_irradiance_and_supersampling(key: str) -> None:
    of = scene(diffuse="irradiance", aovs="nn:normal,d:depth,a:albedo")
    check_derivatives(of, f"integrator.{key}", spp=4)


@pytest.mark.parametrize("key", ["rotation", "metallic", "light"])
def test_derivatives_when_shading_at_surfels(key: str) -> None:
    check_derivatives(scene(shade_at="surfel"), f"integrator.{key}")


@pytest.mark.parametrize("key", ["indirect_sh", "opacity"])
def test_derivatives_with_occlusion(key: str, tmp_path: Path) -> None:
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


@pytest.mark.parametrize("columns", [64, 48], ids=["as it is", "resampled"])
def test_the_scale_of_an_environment_has_a_derivative(columns: int, tmp_path: Path) -> None:
    """Reflections are linear in the scale, in both modes."""
    mi.Bitmap(sky()[:, :columns]).write(str(tmp_path / "sky.exr"))
    channels = integrator(terms="specular")
    del channels["light"]
    emitter = {"type": "envmap", "filename": str(tmp_path / "sky.exr")}
    of = mi.load_dict({"type": "scene", "integrator": channels, "sensor": sensor(), "sky": emitter})
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
    refused(lambda: dr.backward(loss), "cannot be differentiated")


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
    assert not dr.grad_enabled(mi.render(of))


def test_a_parameter_that_changes_nothing_has_tangent_zero() -> None:
    """Forward mode, as reverse mode gives gradient zero."""
    of = scene(reflectance="radiance")
    params = mi.traverse(of)
    leaf = mi.TensorXf(params["integrator.albedo"])
    dr.enable_grad(leaf)
    params["integrator.albedo"] = leaf
    params.update()
    picture = mi.render(of, params)
    dr.set_grad(leaf, dr.ones(mi.TensorXf, leaf.shape))
    assert not np.any(dr.forward_to(picture).numpy())
