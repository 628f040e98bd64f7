"""Images without derivatives: equal to those with derivatives, with requested AOVs only."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render import pipeline
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.points import TERMS
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from tests.helpers import arrays_of
from tests.scenes.integrator import camera_at, image, raw_channels, scattered_discs, scene, sky, two_balls

MAPS = ("albedo", "metallic", "roughness", "visibility")
ALL = {*MAPS, *TERMS, "normal", "depth"}


def things() -> Surfels:
    raw = raw_channels(200)
    return Surfels.from_numpy(raw | {"scale": raw["scale"] - 1.0})


def values(frame: Frame) -> dict[str, np.ndarray]:
    own = frame.background is not None
    return {name: value for name, value in arrays_of(frame).items() if own or name != "object_alpha"}


@pytest.mark.parametrize("at", ["surfel", "pixel"])
def test_forward_only_image_is_the_same(at: Any) -> None:
    near, light = scattered_discs(), EnvironmentLight.from_radiance(sky())
    around = Surroundings(Surfels.from_numpy(near | {"position": 3 * near["position"]}), light)
    traced = at == "pixel"
    shading = Shading(at, "split_sum", "irradiance", occlusion=traced, antialias=traced)
    scene = SurfelScene(things(), shading, shading.light_of(light), Occluder(two_balls()), around)
    frames = (render(scene, camera_at(30.0), Request(scene.all_aovs, only)) for only in (False, True))
    wanted, got = map(values, frames)
    assert {*wanted} == {*got} and 0.02 < wanted["object_alpha"].mean() < 0.98
    for name, value in wanted.items():
        np.testing.assert_array_equal(got[name], value)


def test_nothing_in_view_is_black() -> None:
    behind = replace(camera_at(30.0), origin=mi.Point3f(-9, -15, -30))
    scene = SurfelScene(things(), Shading(reflectance="radiance"))
    for frame in (
        render(scene, behind, Request(scene.all_aovs, forward_only=True)),
        render(replace(scene, surfels=things().gather(mi.UInt32())), behind, Request(forward_only=True)),
    ):
        assert dr.width(frame.alpha) == 45 * 38
        assert not any(value.any() for value in values(frame).values())


@pytest.mark.parametrize("at", ["surfel", "pixel"])
@pytest.mark.parametrize("name", ["", *sorted(ALL)])
def test_frame_contains_requested_aovs_only(at: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    splat = Mock(wraps=pipeline.splat)
    monkeypatch.setattr(pipeline, "splat", splat)
    light = EnvironmentLight.from_radiance(sky())
    shading = Shading(at, "split_sum", "sh", occlusion=at == "pixel")
    scene = SurfelScene(things(), shading, shading.light_of(light), Occluder(two_balls()))
    found = values(render(scene, camera_at(30.0), Request({name} - {""}, forward_only=True)))
    has = {*TERMS} if name in TERMS else {name} - {""}
    nothing = {"visibility"} if at == "surfel" else set()  # is traced
    assert {*found} == {"radiance", "alpha"} | (has - nothing)
    more = {"albedo": 3, "normal": 3, "diffuse": 3, "specular": 3, "metallic": 1, "roughness": 1}
    [blended] = [len(features) for (_, features, *_), _ in splat.call_args_list]
    assert blended == (14 if at == "pixel" else 3 + more.get(name, 0))


def test_the_plugin_filters_a_light_that_changes_again() -> None:
    """It keeps what it filtered for the next image, until its parameters change."""
    changing = scene()
    before = image(changing)
    params = mi.traverse(changing)
    key = next(name for name in params.keys() if name.endswith(".light"))
    brighter = mi.TensorXf(params[key] + 1)
    params[key] = brighter
    params.update()
    after = image(changing)
    assert np.abs(after - before).max() > 0.1
    np.testing.assert_allclose(after, image(scene(light=brighter)), atol=1e-6)
