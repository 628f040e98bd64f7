"""The `refgs` plugin: scenes, lights, parameters, refusals, variants."""

import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.constants import TILE_SIZES, tile_size
from mi_refgs.plugins.light import LOBES, DirectionalLight
from mi_refgs.reference.camera import look_at
from mi_refgs.render.scene_xml import write_scene_xml
from mi_refgs.shade.light.constant import ConstantLight
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.ply import write_ply
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes import integrator as scenes


def test_parameter_keys_do_not_depend_on_the_address(tmp_path: Path) -> None:
    write_ply(tmp_path / "surfels.ply", Surfels.from_numpy(scenes.raw_channels()))
    EnvironmentLight.from_radiance(scenes.sky()).write(tmp_path / "envmap.exr")
    camera = Camera.from_sensor(mi.load_dict(scenes.sensor()))
    files: dict[str, Any] = {"ply": "surfels.ply", "envmap": "envmap.exr", "background": (1, 0.5, 0.25)}
    write_scene_xml(tmp_path / "scene.xml", Shading(), [camera], **files)
    params = mi.traverse(mi.load_file(str(tmp_path / "scene.xml")))
    keys = [key.removeprefix("refgs.") for key in params.keys() if key.startswith("refgs.")]
    assert keys == [*scenes.raw_channels(), "light", "light_to_world"]
    anonymous = '<scene version="3.0.0"><integrator type="refgs">'
    anonymous += f'<string name="filename" value="{tmp_path}/surfels.ply"/>'
    params = mi.traverse(mi.load_string(anonymous + "</integrator></scene>"))
    assert "refgs.roughness" in params and "refgs.light" not in params


def test_lights_of_a_scene_add_up_and_the_rest_is_named_once() -> None:
    """A directional light and a constant one."""
    sky = {"type": "constant", "radiance": 0.3}
    warm = {"type": "rgb", "value": [3, 2, 1]}
    sun = {"type": "directional", "direction": [-1, -1, -0.5], "irradiance": warm}

    def lit(**emitters: dict) -> mi.Scene:
        return scenes.lit_scene(None, emitters, diffuse="irradiance")

    alone = scenes.image(lit(sun=sun))
    assert alone.max() > 0.1
    both = scenes.image(lit(sky=sky, sun=sun))
    np.testing.assert_allclose(both, scenes.image(lit(sky=sky)) + alone, atol=1e-6)

    lamp = {"type": "rectangle", "bulb": {"type": "area"}}
    more = lit(sky=sky, spot={"type": "spot"}, lamp=lamp, floor={"type": "disk"})
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        scenes.image(more), scenes.image(more)
    emitters, shapes = (str(warning.message) for warning in told)
    assert "AreaLight 'bulb', SpotLight 'spot'" in emitters and "'sky'" not in emitters
    assert "Disk 'floor', Rectangle 'lamp'" in shapes
    refused(lambda: scenes.image(lit(spot={"type": "spot"})), "refgs takes none of SpotLight 'spot'")
    glow = sun | {"irradiance": {"type": "blackbody", "temperature": 5e3}}
    refused(lambda: scenes.image(lit(sky=sky, sun=glow)), "emitter 'sun': irradiance: no colour; give an")

    unlit = scenes.lit_scene(sky, reflectance="radiance")
    with pytest.warns(RuntimeWarning, match="emitters .*'sky'.*if its model has one"):
        scenes.image(unlit)
    params = mi.traverse(unlit)
    dr.enable_grad(params["sky.radiance.value"])
    refused(lambda: dr.backward(mi.render(unlit, params)), "sky.radiance.value", "has no derivative")


def test_the_lobe_of_a_directional_light_is_normalised() -> None:
    w = np.linspace(0, np.pi, 100_001)[1:]
    towards = mi.Vector3f(*(mi.Float(x.astype(np.float32)) for x in (np.sin(w), 0 * w, np.cos(w))))
    light = DirectionalLight(ConstantLight(mi.Color3f(0)), mi.Vector3f(0, 0, 1), mi.Color3f(1))
    for roughness in (*LOBES, 0.3, 0.7):
        values = np.array(light.specular(towards, mi.Float(roughness)))[0]
        assert np.sum(values * np.sin(w)) * 2 * np.pi * w[0] == pytest.approx(1, abs=1e-2), roughness


@pytest.mark.filterwarnings("ignore:refgs")  # values are NaN
@pytest.mark.parametrize("bounces", [0, 1])
def test_surfel_count_may_change(bounces: int, tmp_path: Path) -> None:
    """Also where the mesh has their materials."""
    traced: dict[str, Any] = {"mesh": scenes.hollow_mesh(tmp_path), "traced_bounces": bounces}
    turned = np.full((scenes.COUNT + 9, 3), 2, np.float32)
    of = scenes.scene(raw=scenes.raw_channels() | {"curvature": 0 * turned[9:]}, **traced)
    params, other = mi.traverse(of), scenes.raw_channels(scenes.COUNT + 9, seed=5)
    tensors = {name: params[f"integrator.{name}"] for name in other}
    unusable = np.append(np.nan * turned[:30], other["albedo"][30:], axis=0)
    for changes in (other | {"curvature": 0 * turned}, {"curvature": turned}, {"albedo": unusable}):
        for name, values in changes.items():
            params[f"integrator.{name}"] = mi.TensorXf(values)
        params.update()
        other |= changes
        np.testing.assert_array_equal(scenes.image(of), scenes.image(scenes.scene(raw=other, **traced)))
    assert all(of.integrator().surfels.raw[name] is tensor for name, tensor in tensors.items())


@pytest.mark.parametrize(
    ("key", "shape", "words"),
    [
        ("position", (3, 3), "rotation: shape"),
        ("radiance_sh", (scenes.COUNT, 10), "radiance_sh: 10 columns"),
        ("light", (8, 8, 3), "light: shape"),
    ],
)
def test_wrong_shapes_are_refused(key: str, shape: tuple[int, ...], words: str) -> None:
    params = mi.traverse(scenes.scene())
    params[f"integrator.{key}"] = dr.zeros(mi.TensorXf, shape)
    refused(params.update, words)


def test_recording_by_dr_freeze_is_refused() -> None:
    """Dr.Jit would abort the process."""
    of = scenes.scene()
    of.integrator().parameters_changed([])
    refused(lambda: dr.freeze(lambda t: mi.render(of) * t)(mi.Float(1)), "dr.freeze: cannot be recorded")
    assert scenes.image(of).max() > 0.1


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"shade_at": "voxel"}, "shade_at: 'voxel' is unknown"),
        ({"aovs": "normal"}, "<name>:<type>"),
        ({"aovs": "a:colour"}, "unknown type 'colour'"),
        ({"aovs": "a:depth,a:normal"}, "occurs twice"),
        ({"occlusion": True}, "no mesh"),
        ({"visibility_rays": 1.5}, "visibility_rays: 1.5 is not allowed"),
        ({"mesh": "nowhere.ply"}, "nowhere.ply: mesh: no such file"),
        ({"mesh": "nowhere.ply", "shade_at": "surfel"}, "occlusion: needs shading at pixel"),
        ({"light": {"type": "point"}}, "takes no PointLight"),
        ({"light": {"type": "constant", "radiance": {"type": "blackbody", "temperature": 5e3}}}, "no colour"),
        ({"ball": {"type": "sphere"}}, "ball: refgs takes no Shape"),
    ],
)
def test_bad_properties_are_refused(changes: dict, words: str) -> None:
    with pytest.raises(Exception, match=words):
        mi.load_dict(scenes.integrator(**changes))


def test_missing_attributes_are_refused() -> None:
    raw = scenes.raw_channels()
    del raw["roughness"]
    with pytest.raises(Exception, match="roughness: the surfels have no such attribute"):
        mi.load_dict(scenes.integrator(raw, reflectance="split_sum"))
    with pytest.raises(Exception, match="there are no surfels"):
        mi.load_dict({"type": "refgs"})
    refused(lambda: scenes.image(scenes.lit_scene(None)), "light: there is none")
    assert scenes.image(scenes.lit_scene(None, reflectance="radiance")).max() > 0.1  # needs none


def test_nesting_in_stock_integrators_is_refused() -> None:
    nested = {"type": "aov", "aovs": "d:depth", "inner": scenes.integrator()}
    outer = mi.load_dict({"type": "scene", "integrator": nested, "sensor": scenes.sensor()})
    refused(lambda: scenes.image(outer), "whole images only")


@pytest.mark.parametrize("factor", [1 - 1e-3, 1, 1 + 1e-3])
@pytest.mark.parametrize("limit", [limit for limit, _ in TILE_SIZES[:-1]])
@pytest.mark.parametrize("size", [(512, 512), (801, 333)])
def test_an_exported_scene_has_the_trainers_tiles(
    size: tuple[int, int], limit: float, factor: float, tmp_path: Path
) -> None:
    """Also at the focal lengths where tiles change size: a sensor's float32 rays give 511.9998 for 512."""
    width, height = size
    focal = limit * factor
    pose = look_at(np.random.default_rng(1).normal(size=3), np.zeros(3))
    camera = Camera.from_pose(width, height, -focal, -focal, width / 2 + 3, height / 2 - 5, pose, 0.01)
    write_scene_xml(tmp_path / "scene.xml", Shading(), [camera], "a.ply")
    root = ElementTree.parse(tmp_path / "scene.xml").getroot()
    root.remove(root.find("integrator"))  # type: ignore[arg-type]
    exported = Camera.from_sensor(mi.load_string(ElementTree.tostring(root, encoding="unicode")).sensors()[0])
    assert exported.focal == pytest.approx(focal, rel=2e-6)
    assert exported.tile == camera.tile == tile_size(focal)


def test_variants() -> None:
    before = scenes.image(scenes.scene())
    mi.set_variant("scalar_rgb")
    mi.set_variant("llvm_ad_rgb")
    np.testing.assert_array_equal(scenes.image(scenes.scene()), before)
