"""Derivatives of mi.render with the `refgs` plugin, in both modes, against its central differences."""

from collections.abc import Callable
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.surfels.attributes import ATTRIBUTES
from tests import gradients
from tests.helpers import slow, with_grad
from tests.scenes import integrator as scenes


def test_every_parameter_is_in_the_table(tmp_path: Path) -> None:
    """Those of scenes with every feature, refused with the sentence that is listed, or exact."""
    found, listed = {key: (of, able) for key, of, able in gradients.parameters(tmp_path)}, gradients.listed()
    assert [*listed] == [*found] and {f"integrator.{name}" for name in ATTRIBUTES} <= {*listed}
    for key, (of, able) in found.items():
        if able:
            assert float(listed[key]) < scenes.TANGENT_TOLERANCE, key
        else:
            assert gradients.refusals(of, key) == {listed[key]}


@pytest.mark.parametrize(
    ("keys", "threads"),
    [(("sky.to_world", "sensor.principal_point_offset_y"), 2), slow((), 1), slow((), 2)],
    ids=["some", "all, one thread", "all, two threads"],
)
def test_derivatives_by_parameters(
    keys: tuple[str, ...], threads: int, tmp_path: Path, set_threads: Callable[[int], None]
) -> None:
    set_threads(threads)
    for key, of, able in gradients.parameters(tmp_path):
        if able and (not keys or key in keys):
            scenes.check_derivatives(of, key)


@pytest.mark.slow
def test_rotations_of_the_environment_have_derivatives_in_loops() -> None:
    scenes.check_derivatives(scenes.scene(reflectance="monte_carlo"), "integrator.light_to_world")


@pytest.mark.parametrize("key", ["integrator.albedo", "integrator.light", "sensor.x_fov"])
def test_derivatives_by_parameters_that_are_not_used_are_zero(key: str) -> None:
    """Those of a model's other attributes and of other sensors: loops pass them at every stage and view."""
    cameras = {"sensor": scenes.sensor(), "other": scenes.sensor(fov=40)}
    of = mi.load_dict({"type": "scene", "integrator": scenes.integrator(reflectance="radiance"), **cameras})
    params = mi.traverse(of)
    dr.enable_grad(params[key])
    params.update()
    dr.set_grad(params[key], 1)
    assert not np.any(dr.forward_to(mi.render(of, params, sensor=1)).numpy())
    dr.set_grad(params[key], 0)
    dr.backward(dr.sum(mi.render(of, params, sensor=1), axis=None))
    assert not np.any(np.array(dr.grad(params[key])))


def test_resampled_environments_have_derivatives_by_their_scale_only(tmp_path: Path) -> None:
    mi.Bitmap(scenes.sky()[:, :48]).write(str(tmp_path / "odd.exr"))  # 32 x 48
    of = scenes.lit_scene({"type": "envmap", "filename": str(tmp_path / "odd.exr")})
    scenes.check_derivatives(of, "sky.scale")
    [sentence] = gradients.refusals(of, "sky.data")
    assert "a map of 32 x 48 is resampled" in sentence


@pytest.mark.parametrize(
    ("key", "derived", "most"),
    [("position", False, scenes.WIDTH * scenes.HEIGHT // 3), ("light", True, None), ("albedo", False, None)],
)
def test_tangents_add_up_over_losses(
    key: str, derived: bool, most: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Forward mode, as reverse mode, with images and other losses on a parameter, in any order."""
    if most is not None:
        monkeypatch.setattr("mi_refgs.plugins.film.DERIVATIVE_SAMPLES", most)
    of = scenes.scene(occlusion=False)
    params = mi.traverse(of)
    base = mi.TensorXf(params[f"integrator.{key}"])

    def weighed(name: str, leaf: mi.TensorXf) -> mi.Float:
        if name == "image":
            return dr.mean(mi.render(of, params), axis=None).array
        used = leaf if name == "leaf" else params[f"integrator.{key}"]
        return dr.mean(dr.square(used.array))

    def tangent(*names: str) -> float:
        leaf = with_grad(mi.TensorXf(base), dr.ones(mi.TensorXf, base.shape))
        params[f"integrator.{key}"] = 2 * leaf if derived else leaf
        params.update()
        return float(dr.forward_to(sum((weighed(name, leaf) for name in names), mi.Float(0)))[0])

    alone = {name: tangent(name) for name in ("image", "leaf", "parameter")}
    for names in (("parameter", "image", "leaf"), ("image", "parameter"), ("image", "image")):
        assert tangent(*names) == pytest.approx(sum(alone[name] for name in names), rel=1e-4, abs=1e-6), names
    assert alone["image"] != 0
