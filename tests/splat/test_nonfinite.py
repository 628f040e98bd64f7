"""Values that are NaN, infinite or huge: they end no process, spoil no image, and are named."""

import warnings
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.surfels.attributes import ATTRIBUTES
from tests.helpers import ROOT, run_python, slow
from tests.scenes.integrator import COUNT, lit_scene, plane_mesh, raw_channels, scene, sky

BAD = (np.nan, np.inf, -np.inf, 1e38, -1e38)
CULPRITS = [3, 8, 11, 17, 20]  # one for each

PROGRAM = """
import warnings
import mi_refgs
import mitsuba as mi, drjit as dr
mi.set_variant("llvm_ad_rgb")
from tests.scenes.integrator import scene
made = scene()
params = mi.traverse(made)
params["integrator.roughness"] = dr.full(mi.TensorXf, float("nan"), (24, 1))
params.update()
dr.enable_grad(params["integrator.roughness"])
warnings.simplefilter("ignore")  # that values are unusable
dr.backward(dr.sum(mi.render(made, params)))
print(dr.grad(params["integrator.roughness"]).numpy().sum())
"""


def test_a_nan_roughness_does_not_end_the_process() -> None:
    assert float(run_python(PROGRAM, folder=ROOT)) == 0


def rendered(made: "mi.Scene", values: dict[str, np.ndarray]) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The image with these parameters, and the gradient of a weighted sum of it."""
    params = mi.traverse(made)
    for name, value in values.items():
        params[f"integrator.{name}"] = mi.TensorXf(value)
    params.update()
    for name in values:
        dr.enable_grad(params[f"integrator.{name}"])
    image = mi.render(made, params, spp=1)
    weights = np.random.default_rng(5).normal(size=image.shape).astype(np.float32)
    dr.backward(dr.sum(image * mi.TensorXf(weights)))
    # Dr.Jit's view of its own memory must not outlive the tensor.
    gradients = {name: np.array(dr.grad(params[f"integrator.{name}"]).numpy()) for name in values}
    return image.numpy(), gradients


KINDS: dict[str, dict[str, Any]] = {
    "surfel": {"shade_at": "surfel"},
    "bounces": {"diffuse": "irradiance", "traced_bounces": 1, "visibility_rays": 2},
    "pixel": {},
    "mesh": {"traced_bounces": 0},
}


@pytest.mark.filterwarnings("ignore:refgs:RuntimeWarning")
@pytest.mark.parametrize("kind", ["surfel", "bounces", slow("pixel"), slow("mesh")])
def test_surfel_with_unusable_value_is_ignored(kind: str, tmp_path: Path) -> None:
    raw = raw_channels()
    mesh: Any = {"mesh": plane_mesh(tmp_path)} if "traced_bounces" in KINDS[kind] else {}
    made = scene(**KINDS[kind], **mesh)
    light = np.array(mi.traverse(made)["integrator.light"].numpy())
    others = np.setdiff1d(np.arange(COUNT), CULPRITS)
    kept = {name: value[others] for name, value in raw.items()}
    wanted, gradients = rendered(made, kept | {"light": light})
    assert wanted.max() > 0.1
    for channel in raw:
        values = {name: value.copy() for name, value in raw.items()}
        # A large number saturates where the activation has a bound, and does so without a NaN.
        values[channel][CULPRITS, -1] = (*BAD[:3], np.nan, np.inf) if ATTRIBUTES[channel].bounded else BAD
        image, found = rendered(made, values | {"light": light})
        np.testing.assert_allclose(image, wanted, rtol=1e-5, atol=1e-6, err_msg=channel)
        for name, gradient in found.items():
            case, expected = f"{channel}: δ{name}", gradients[name]
            if name != "light":
                assert not gradient[CULPRITS].any(), case
                gradient = gradient[others]
            atol = 1e-4 * np.abs(expected).max()
            np.testing.assert_allclose(gradient, expected, rtol=1e-3, atol=atol, err_msg=case)


@pytest.mark.filterwarnings("ignore:refgs:RuntimeWarning")
def test_the_materials_of_a_mesh_stay_finite_without_a_new_search_for_neighbours(tmp_path: Path) -> None:
    made = scene(mesh=plane_mesh(tmp_path), traced_bounces=1)
    values = {channel: raw_channels()[channel] for channel in ("roughness", "radiance_sh")}
    for value in values.values():
        value[CULPRITS] = np.nan
    image, gradients = rendered(made, values)
    assert np.isfinite(image).all()
    for gradient in gradients.values():
        assert np.isfinite(gradient).all() and not gradient[CULPRITS].any()


@pytest.mark.filterwarnings("ignore:refgs:RuntimeWarning")
def test_unusable_texel_of_the_light_is_black() -> None:
    made = scene()
    raw = raw_channels()
    light = np.array(mi.traverse(made)["integrator.light"].numpy())
    light[7, 11:16, 1] = -80  # a radiance of 1e-35
    wanted, gradients = rendered(made, raw | {"light": light})
    light[7, 11:16, 1] = BAD
    image, found = rendered(made, raw | {"light": light})
    np.testing.assert_allclose(image, wanted, rtol=1e-5, atol=1e-6)
    assert not found["light"][7, 11:16, 1].any()
    for name, gradient in found.items():
        np.testing.assert_allclose(gradient, gradients[name], rtol=1e-3, atol=1e-5, err_msg=name)


def test_unusable_texel_of_the_scene_light_is_black() -> None:
    def made(values: object) -> np.ndarray:
        loaded = lit_scene({"type": "envmap", "bitmap": mi.Bitmap(sky())})
        params = mi.traverse(loaded)
        data = np.array(params["sky.data"].numpy())
        data[7, 11:16, 1] = values
        params["sky.data"] = mi.TensorXf(data)
        params.update()
        return mi.render(loaded, spp=1).numpy()

    np.testing.assert_allclose(made(BAD), made(0), rtol=1e-5, atol=1e-6)


def test_finite_extremes_leave_everything_finite() -> None:
    raw = raw_channels()
    rng = np.random.default_rng(8)
    made = scene()
    for _ in range(6):
        values = {name: value.copy() for name, value in raw.items()}
        for value in values.values():
            huge = rng.choice([-1, 1], value.shape) * 10 ** rng.uniform(-18, 18, value.shape)
            value += np.where(rng.random(value.shape) < 0.2, huge, 0)
        image, gradients = rendered(made, values)
        assert np.isfinite(image).all()
        assert all(np.isfinite(gradient).all() for gradient in gradients.values())


def test_plugin_warns_once_with_attribute_count_and_first_surfel() -> None:
    made = scene()
    params = mi.traverse(made)
    mi.render(made, spp=1)
    values = raw_channels()["metallic"]
    values[CULPRITS] = np.nan
    params["integrator.metallic"] = mi.TensorXf(values)
    params.update()
    with pytest.warns(RuntimeWarning, match=r"5 surfels in metallic \(first: 3\)"):
        mi.render(made, spp=1)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        params.update({"integrator.metallic": mi.TensorXf(values)})
        mi.render(made, spp=1)
    params.update({"integrator.roughness": params["integrator.roughness"] * np.nan})
    made.integrator().next_check = 0
    with pytest.warns(RuntimeWarning, match=r"beyond 1e\+18: \d+ surfels in roughness"):
        mi.render(made, spp=1)
