"""`Reconstruction.from_params`: the state of a loop is what save, relight, export and view take."""

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs import Reconstruction
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from tests.helpers import refused
from tests.scenes.integrator import sky


def test_round_trip_keeps_the_image(balls: Reconstruction, known: Path, tmp_path: Path) -> None:
    """From a scene, its parameters, and their arrays; saved, it is a run that can be relit and exported."""
    scene = balls.scene()
    params = mi.traverse(scene)
    arrays = {name: x for name, x in params.items() if name.startswith("refgs.") and "to_world" not in name}
    camera, before = balls.camera(0), balls.render(0)
    of_arrays: dict[str, Any] = {"mesh": balls.trained.mesh, "shading": balls.trained.shading}
    for given in (scene, params, arrays):
        options = of_arrays if given is arrays else {}
        made = Reconstruction.from_params(given, **options, data=known / "data")
        np.testing.assert_allclose(made.render(0), before, atol=1e-6)
    saved = Reconstruction.from_params(params).save(tmp_path / "run")
    np.testing.assert_allclose(saved.render(camera), before, atol=1e-6)
    relit = [one.relight(np.full((16, 32, 3), 0.7)).trained for one in (saved, balls)]
    assert relit[0].shading == relit[1].shading and [*relit[0].surfels.raw] == [*relit[1].surfels.raw]
    assert saved.export("cameras", tmp_path / "cameras")
    params["refgs.roughness"] = params["refgs.roughness"] + 1
    dr.enable_grad(params["refgs.roughness"])
    params.update()
    changed, camera = Reconstruction.from_params(params), mi_refgs.Camera.from_sensor(scene.sensors()[0])
    np.testing.assert_allclose(changed.render(camera)[..., :3], mi.render(scene, spp=1)[..., :3], atol=1e-6)
    assert not dr.grad_enabled(changed.trained.surfels.raw["roughness"])


def test_light_of_the_scene_is_taken_in_world_directions(balls: Reconstruction) -> None:
    """A rotated environment, of the integrator or of the scene, becomes a map without rotation."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 70)
    turned = {"type": "envmap", "bitmap": mi.Bitmap(sky(16)), "to_world": turn}
    camera = balls.camera(0, 24)
    sensor = balls.scene(camera).sensors()[0]
    for inside in (True, False):
        surfels: dict[str, Any] = {"type": "refgs", **balls.trained.surfels.raw, "reflectance": "split_sum"}
        surfels |= {"light": turned} if inside else {}
        parts = {"refgs": surfels, "sensor": sensor} | ({} if inside else {"sky": turned})
        scene = mi.load_dict({"type": "scene", **parts})
        expected = mi.render(scene, spp=1).numpy()
        found = Reconstruction.from_params(scene)
        assert found.trained.light is not None and found.trained.light.height == 64
        shown = found.render(camera)[..., :3]
        np.testing.assert_allclose(shown, expected[..., :3], atol=0.01 * expected.max())
    scene = mi.load_dict({"type": "scene", **parts, "sky": turned | {"to_world": mi.ScalarTransform4f()}})
    exact = Reconstruction.from_params(scene).render(camera)[..., :3]
    np.testing.assert_allclose(exact, mi.render(scene, spp=1)[..., :3], atol=1e-5)


@pytest.mark.parametrize("behind", [None, [0.1, 0.2, 0.3], sky(16)])
@pytest.mark.parametrize("surrounded", [True, False])
def test_what_is_behind_is_taken(balls: Reconstruction, behind: Any, surrounded: bool) -> None:
    """A colour, too; as a copy, which the loop does not change."""
    camera = balls.camera(0, 24)
    own = balls.trained.surfels.raw | {"type": "refgs", "reflectance": "radiance"}
    if surrounded:
        own |= {f"surroundings_{x}": own[x] for x in (*balls.trained.surfels.primitive.widths, "radiance_sh")}
    if behind is not None:
        own["background"] = mi.Color3f(behind) if len(behind) == 3 else mi.TensorXf(behind)
    scene = mi.load_dict({"type": "scene", "refgs": own, "sensor": balls.scene(camera).sensors()[0]})
    black = surrounded and behind is None
    with pytest.warns(RuntimeWarning, match="becomes black") if black else nullcontext():
        made = Reconstruction.from_params(scene)
    before = mi.render(scene, spp=1).numpy()
    if "refgs.background" in (params := mi.traverse(scene)):
        params.update({"refgs.background": 0 * params["refgs.background"]})
    np.testing.assert_allclose(made.render(camera)[..., :3], before[..., :3], atol=1e-5)


def test_models_without_mirror_rays_keep_the_mesh(balls: Reconstruction) -> None:
    """Also one that is not used, for relighting; visibility is the share of free directions."""
    trained = balls.trained
    assert trained.light is not None
    quality: dict[str, Any] = {"split_sum": {}, "monte_carlo": {"directions": 8}}
    for model, options in quality.items():
        shading = ShadingOptions("surfel", model, "irradiance" if model == "split_sum" else "sh", **options)
        names = {*trained.surfels.primitive.widths, *MODELS[model].required_attributes(shading)}
        arrays = {name: trained.surfels.raw[name] for name in names} | {"light": trained.light.raw}
        made = Reconstruction.from_params(arrays, mesh=trained.mesh, shading=shading)
        assert Reconstruction.from_params(made.scene()).trained.mesh is not None
    seen = made.aovs(0, ["visibility", "alpha"])
    assert 0.1 < seen["visibility"][seen["alpha"] > 0.5].min() < 0.8


def test_other_states_are_refused(balls: Reconstruction) -> None:
    arrays, make = balls.trained.surfels.to_numpy(), Reconstruction.from_params
    refused(lambda: make(mi.load_dict({"type": "sphere"})), "no `refgs` integrator")
    refused(lambda: make(arrays | {"hue": arrays["opacity"]}), "hue")
    refused(lambda: make({name: x for name, x in arrays.items() if name != "scale"}), "scale")
    refused(lambda: make(arrays), "shading: light: reflectance = split_sum needs one")
    traced = ShadingOptions(occlusion=True, traced_bounces=2, diffuse="irradiance")
    refused(lambda: make(arrays | {"light": sky(16)}, shading=traced), "occlusion: there is no mesh to trace")
    refused(lambda: make(arrays | {"opacity": np.full_like(arrays["opacity"], np.nan)}), "NaN")
    refused(lambda: make(arrays | {"light": np.full((8, 16, 3), np.nan)}), "NaN")
    white = {"type": "refgs", **balls.trained.surfels.raw, "background": mi.Color3f(np.nan)}
    refused(lambda: mi.load_dict(white), "is no colour")
    params = mi.traverse(balls.scene())
    params.update({"refgs.opacity": params["refgs.opacity"] * np.nan})
    refused(lambda: make(params), "NaN")
    sun = {"type": "directional", "direction": [0, 0, -1]}
    surfels = {"type": "refgs", **balls.trained.surfels.raw, "reflectance": "split_sum"}
    sunny = mi.load_dict({"type": "scene", "refgs": surfels, "sun": sun})
    refused(lambda: make(sunny), "its light is not an environment alone")
    refused(lambda: make(mi.traverse(sunny.integrator())), "its light is not an environment alone")
    refused(lambda: make(balls.scene(), shading=balls.trained.shading), "a scene has its own")
