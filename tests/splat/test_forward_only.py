"""Images without derivatives: equal to those with derivatives, with requested AOVs only."""

from dataclasses import replace
from typing import Any
from unittest.mock import Mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs import splat
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render import pipeline
from mi_refgs.render.pipeline import Frame, Request, SurfelScene, render
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.points import TERMS
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.lanes import CompactedPixels, Grid, Lanes
from mi_refgs.surfels.table import Surfels
from tests.helpers import arrays_of
from tests.scenes.integrator import camera_at, image, raw_channels, scattered_discs, scene, sky, two_balls

MAPS = ("albedo", "metallic", "roughness", "visibility")
ALL = {*MAPS, *TERMS, "normal", "depth"}


def things(gaussians: bool = False) -> Surfels:
    raw = raw_channels(200)
    raw["scale"] = raw["scale"] - 1.0
    if gaussians:
        raw["scale"] = np.concatenate([raw["scale"], raw["scale"][:, :1]], axis=1)
    return Surfels.from_numpy(raw)


def values(frame: Frame) -> dict[str, np.ndarray]:
    own = frame.background is not None
    return {name: value for name, value in arrays_of(frame).items() if own or name != "object_alpha"}


def assert_same(expected: Frame, found: Frame) -> None:
    """Maps are divided by alpha, so that only those of pixels that show something are alike."""
    wanted, got = values(expected), values(found)
    assert {*wanted} == {*got}
    seen = np.array(expected.alpha) > 0.02
    assert 0.02 < seen.mean() < 0.98
    if "visibility" in wanted:
        assert 0.02 < wanted["visibility"][seen].mean() < 0.995
    for name, value in wanted.items():
        assert got[name].shape == value.shape, name
        part = seen if name in (*MAPS, "depth") else slice(None)
        np.testing.assert_allclose(got[name][..., part], value[..., part], atol=2e-5, rtol=5e-6, err_msg=name)
    np.testing.assert_allclose(got["radiance"], wanted["radiance"], atol=2e-6)
    np.testing.assert_allclose(got["alpha"], wanted["alpha"], atol=2e-6)


IRRADIANCE = Shading("pixel", "split_sum", "irradiance")
TRACED = Shading("pixel", "split_sum", "sh", occlusion=True)
CASES: dict[str, tuple[Shading, dict[str, Any]]] = {
    "tiles of 8 × 8, with an offset": (TRACED, {"focal": 1100.0, "offset": (13, 6)}),
    "tiles of 8 × 4, with an offset": (TRACED, {"focal": 600.0, "offset": (5, 3)}),
    "tiles of 4 × 4": (TRACED, {}),
    "at surfels": (replace(IRRADIANCE, at="surfel"), {}),
    "Gaussians at pixels": (IRRADIANCE, {"gaussians": True}),
    "surroundings": (IRRADIANCE, {"around": True}),
    "surroundings at surfels": (replace(IRRADIANCE, at="surfel"), {"around": True}),
    "lobe samples of the pixel": (replace(IRRADIANCE, occlusion=True, visibility_rays=4), {}),
    "neighbours in the image": (Shading(antialias=True), {}),
    "neighbours and rays": (Shading(antialias=True, occlusion=True), {}),
}


@pytest.mark.parametrize("case", CASES)
def test_forward_only_image_is_the_same(case: str) -> None:
    shading, more = CASES[case]
    near, light = scattered_discs(), EnvironmentLight.from_radiance(sky())
    far = Surfels.from_numpy(near | {"position": 3 * near["position"]})
    around = Surroundings(far, light) if "around" in more else None
    surfels, occluder = things("gaussians" in more), Occluder(two_balls())
    scene = SurfelScene(surfels, shading, shading.light_of(light), occluder, around)
    view = camera_at(more.get("focal", 30.0), more.get("offset", (0, 0)))
    assert_same(*(render(scene, view, Request(scene.all_aovs, only)) for only in (False, True)))


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
    composite = Mock(wraps=pipeline.composite_compact)
    monkeypatch.setattr(pipeline, "composite_compact", composite)
    light = EnvironmentLight.from_radiance(sky())
    shading = Shading(at, "split_sum", "sh", occlusion=at == "pixel")
    scene = SurfelScene(things(), shading, shading.light_of(light), Occluder(two_balls()))
    found = values(render(scene, camera_at(30.0), Request({name} - {""}, forward_only=True)))
    has = {*TERMS} if name in TERMS else {name} - {""}
    nothing = {"visibility"} if at == "surfel" else set()  # is traced
    assert {*found} == {"radiance", "alpha"} | (has - nothing)
    more = {"albedo": 3, "normal": 3, "diffuse": 3, "specular": 3, "metallic": 1, "roughness": 1}
    deferred = 14 + (name == "depth")
    blended = [lists.features + depth for (lists, depth), _ in composite.call_args_list]
    assert blended == [deferred if at == "pixel" else 3 + (more | {"depth": 1}).get(name, 0)]


def test_compacted_pixels_contain_each_pixel_of_chosen_patches_once() -> None:
    view = camera_at(30.0, (3, 2))
    lists = splat.list_by_tile(splat.project([things()], view), view)
    chosen = Lanes.filled(lists)
    assert 0 < dr.width(chosen) < Grid(view).patches
    pixels = CompactedPixels.of(view, chosen, Lanes.of(lists, chosen))
    there, raster = np.array(pixels.there), np.array(pixels.raster)
    np.testing.assert_array_equal(raster[np.array(pixels.index)[there]], np.flatnonzero(there))
    alpha = np.array(splat.splat([things()], [], view).alpha)
    assert not alpha[~there].any() and alpha[there].any()


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
