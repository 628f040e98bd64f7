"""Path-traced data sets: cameras, pixels, maps and light agree with each other; folders resume."""

import json
import math
import shutil
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import Mock, create_autospec

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.data.dataset import Dataset
from mi_refgs.io.exr import write_exr
from mi_refgs.shade.light import lobe_matrices
from mi_refgs.shade.light.latlong import environment_image
from mi_refgs.shade.light.light_file import read_radiance
from mi_refgs.synthesis import pathtrace
from mi_refgs.synthesis.make_dataset import make_dataset
from mi_refgs.synthesis.options import DatasetOptions, scene_hash
from mi_refgs.synthesis.settings import load_scene, under_light
from tests.helpers import AXES, contents, emitted, read_loaded, refused, slow, unit, vector
from tests.scenes.integrator import sky
from tests.scenes.sphere import CENTRE, RADIUS, SCENE

SCENES = Path(__file__).parents[2] / "scenes"
SIZE = 16

OPTIONS: dict[str, Any] = {"views": 3, "test_views": 2, "size": SIZE, "spp": 16, "progress": False}
OPTIONS["environment_height"] = 64


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of one sphere, off the origin."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / "ball.xml").write_text(SCENE)
    return make_dataset(folder / "ball.xml", folder / "out", **OPTIONS)


def test_depth_and_normals_are_those_of_the_sphere(made: Path) -> None:
    """Through the reader's camera, so that file convention, pixel centres and maps are tested as one."""
    for split in ("train", "test"):
        for view in read_loaded(made, split).views:
            assert view.depth is not None and view.normal is not None and view.alpha is not None
            points = view.to_world[:3, 3] + np.array(view.camera().rays()).T * view.depth.reshape(-1, 1)
            hit = view.depth.ravel() > 0
            assert 0.6 < hit.mean() < 0.8  # π/4 · 0.95²
            expected = (points[hit] - CENTRE) / RADIUS
            np.testing.assert_allclose(np.linalg.norm(expected, axis=1), 1, atol=1e-4)
            np.testing.assert_allclose(view.normal.reshape(-1, 3)[hit], expected, atol=1e-3)
            assert not view.normal.reshape(-1, 3)[~hit].any()
            np.testing.assert_array_equal(view.alpha.ravel()[hit] > 0, True)


def test_radiance_is_that_of_the_lit_sphere(made: Path) -> None:
    data = read_loaded(made, "train", images="exr", background="black")
    check_brightness(data, data, environment_image(mi.load_string(SCENE), 16))


def check_brightness(radiance: Dataset, shape: Dataset, light: np.ndarray) -> None:
    """Views of the sphere are as bright as albedo × irradiance / π of a light (16, 32, 3), by its normals."""
    row, column = np.divmod(np.arange(16 * 32), 32)
    theta, phi = lobe_matrices.row_angles(16)[row], lobe_matrices.column_angles(32)[column]
    direction = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=1)
    weight = lobe_matrices.row_areas(16)[row] * (np.pi / 16)
    for view, known in zip(radiance.views, shape.views, strict=True):
        assert known.normal is not None and view.alpha is not None
        inside = (view.alpha == 1) & np.any(known.normal != 0, axis=-1)
        cosine = np.maximum(known.normal[inside] @ direction.T, 0)
        expected = 0.5 / math.pi * (cosine * weight) @ light.reshape(-1, 3)
        np.testing.assert_allclose(view.image[inside].mean(0), expected.mean(0), rtol=0.04)


def test_rotated_environment_is_resampled(made: Path, rng: np.random.Generator) -> None:
    """The file of the data set; a smooth light, turned to an oblique axis, poles included; a constant one."""
    assert read_loaded(made, "train").environment == made / "environment.exr"
    np.testing.assert_array_equal(
        read_radiance(made / "environment.exr"), environment_image(mi.load_string(SCENE), 64)
    )
    turn = mi.ScalarTransform4f().rotate([0.6, 0, 0.8], 50)
    light = {"type": "envmap", "bitmap": mi.Bitmap(sky(64)), "to_world": turn}
    scene = mi.load_dict({"type": "scene", "e": light})
    copy = mi.load_dict({"type": "envmap", "bitmap": mi.Bitmap(environment_image(scene, 64))})
    directions = np.concatenate([AXES, rng.normal(size=(2000, 3))])
    seen, truth = (emitted(emitter, directions) for emitter in (copy, scene.environment()))
    np.testing.assert_allclose(seen[:6], truth[:6], rtol=2e-3)
    np.testing.assert_allclose(seen, truth, rtol=0.02)  # beside a pole a texel is narrow
    colour = {"type": "rgb", "value": [1, 2, 3]}
    scene = mi.load_dict({"type": "scene", "e": {"type": "constant", "radiance": colour}})
    np.testing.assert_allclose(environment_image(scene, 4), np.full((4, 8, 3), [1, 2, 3]), rtol=1e-5)


def test_camera_poses_are_seeded_and_evenly_spread() -> None:
    def poses(seed: int) -> np.ndarray:
        ranges = (4.0, 4.0), (-30, 80), (0, 360)
        return pathtrace.camera_poses(60, CENTRE, *ranges, np.random.default_rng(seed))

    first = poses(1)
    np.testing.assert_array_equal(first, poses(1))
    assert np.abs(first - poses(2)).max() > 0.1
    outward = (first[:, :3, 3] - CENTRE) / 4
    np.testing.assert_allclose(outward, -first[:, :3, 2], atol=1e-12)
    rotation = first[:, :3, :3]
    np.testing.assert_allclose(rotation.transpose(0, 2, 1) @ rotation - np.eye(3), 0, atol=1e-12)
    assert np.all(np.linalg.det(rotation) > 0) and np.all(rotation[:, 2, 1] > 0)
    elevation = np.degrees(np.arcsin(outward[:, 2]))
    assert -30 < elevation.min() < -25 and 70 < elevation.max() < 80
    apart = np.degrees(np.arccos(np.clip(outward @ outward.T - 2 * np.eye(60), -1, 1))).min(axis=1)
    assert apart.min() > 7 and np.median(apart) > 15  # a perfect lattice: 22°


@pytest.fixture
def trace(monkeypatch: pytest.MonkeyPatch) -> Mock:
    """Records the images that are path-traced from now on."""
    recorded: Mock = create_autospec(pathtrace.Tracer.image, side_effect=pathtrace.Tracer.image)
    monkeypatch.setattr(pathtrace.Tracer, "image", recorded)
    return recorded


def test_unfinished_folder_is_continued(made: Path, trace: Mock) -> None:
    scene, before = made.parent / "ball.xml", contents(made)
    (made / "train/r_001.png").unlink()
    (made / "test/r_000_depth.exr").unlink()
    (made / "transforms_train.json").unlink()
    make_dataset(scene, made, **OPTIONS)
    assert trace.call_count == 2 and contents(made) == before


def test_other_settings_need_overwrite(made: Path, tmp_path: Path) -> None:
    scene = tmp_path / "ball.xml"
    scene.write_text(SCENE)
    tiny = {**OPTIONS, "views": 1, "test_views": 1, "size": 4, "environment_height": 0}
    out = make_dataset(scene, tmp_path / "out", **{**tiny, "views": 2})
    refused(lambda: make_dataset(scene, out, **tiny), "dataset.json: --views:", "overwrite")
    scene.write_text(SCENE.replace("0.7", "0.6"))
    refused(lambda: make_dataset(scene, out, **{**tiny, "views": 2}), "dataset.json: the scene file:")
    make_dataset(scene, out, **tiny, overwrite=True)
    assert not (out / "train/r_001.png").exists()
    (out / "dataset.json").write_text("[]")
    refused(lambda: make_dataset(scene, out, **tiny, overwrite=True), "not empty, and no data set")


def test_render_passes_are_averaged(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = mi.load_string(SCENE)
    pose = pathtrace.camera_poses(1, CENTRE, (3.0, 3.0), (0, 30), (0, 360), np.random.default_rng(0))[0]
    cameras = pathtrace.Cameras(DatasetOptions(size=8, fov=30, spp=64, max_depth=3), CENTRE, RADIUS, RADIUS)
    whole = pathtrace.Tracer(scene, cameras).image(pose, 5)
    monkeypatch.setattr(pathtrace, "SAMPLES_PER_LAUNCH", 8 * 8 * 16)
    split = pathtrace.Tracer(scene, cameras)
    assert (split.passes, split.spp) == (4, 16)
    np.testing.assert_allclose(split.image(pose, 5).mean(), whole.mean(), rtol=0.02)


WRONG: dict[str, list[Any]] = {
    "views": [0, 2.5, None],
    "elevation": [(50, 20), 30, (10, None)],
    "azimuth": [(50, 20), (0, 400)],
    "fov": [200, "wide"],
    "seed": [-1],
    "resolution": [0, (16, 8, 4), "16x8"],
    "distance": [3, (3, 2)],
}


@pytest.mark.parametrize(("field", "value"), [(field, value) for field in WRONG for value in WRONG[field]])
def test_settings_out_of_range(made: Path, tmp_path: Path, field: str, value: Any) -> None:
    key = "size" if field == "resolution" else field
    make = partial(make_dataset, made.parent / "ball.xml", tmp_path / "out", **OPTIONS | {key: value})
    refused(make, f"ball.xml: {field}", " is out of range; give ")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<scene", "not XML"),
        ('<scene version="3.0.0"><shape type="blob"/></scene>', "scene.xml: scene: "),
        ('<scene version="3.0.0"><shape type="sphere"/></scene>', "emitters: the scene has none"),
    ],
)
def test_bad_scene(tmp_path: Path, text: str, words: str) -> None:
    (scene := tmp_path / "scene.xml").write_text(text)
    refused(lambda: make_dataset(scene, tmp_path / "out", **OPTIONS), scene, words)


@pytest.mark.parametrize("name", ["mixed", slow("mirror_ring"), slow("patched_ball"), slow("diffuse")])
def test_example_scenes(name: str) -> None:
    """Loads in plain Mitsuba; about one unit large, around the origin."""
    scene = mi.load_file(str(SCENES / f"{name}.xml"), resx=8, resy=8, spp=4)
    image = np.array(mi.render(scene))
    assert image.shape == (8, 8, 4) and np.isfinite(image).all()
    assert image[0, 0, 3] == 0 and image[3:5, 3:5, 3].min() > 0.5
    centre, radius = pathtrace.bounding_sphere(scene.shapes())
    assert np.abs(centre).max() < 0.2 and 0.8 < radius < 1.15
    assert scene.environment() is not None and len(scene.emitters()) == 1


ROOMS = {
    "tabletop": (("jug", "handle", "knob"), (2.7, 3.4), (0, 360)),
    "figure": (("red_parts", "silver_parts"), (1.9, 2.3), (0, 360)),
    "can": (("ends", "wall", "tab"), (3.2, 3.8), (0, 360)),
    "glass_shelf": (("mug_outside", "mug_inside"), (3.4, 4.2), (-160, -20)),
}
"""Shapes, distances and azimuths with which scenes/README.md makes data sets of objects in rooms."""


@pytest.mark.slow
@pytest.mark.parametrize("name", ROOMS)
def test_rooms_are_closed_and_show_the_whole_object(name: str, tmp_path: Path) -> None:
    """Loads in plain Mitsuba; every ray meets something; the object is whole in nearly every view."""
    scene = mi.load_file(str(SCENES / f"{name}.xml"), resx=9, resy=16, spp=4)
    outward = vector(unit(np.random.default_rng(0).normal(size=(4000, 3))))
    assert dr.all(scene.ray_test(mi.Ray3f(mi.Point3f(0, 0, 1.5), outward))) and scene.environment() is None
    objects, distance, azimuth = ROOMS[name]
    tiny = OPTIONS | {"views": 12, "size": (18, 32), "spp": 1, "environment_height": 0}
    tiny |= {"objects": objects, "distance": distance, "azimuth": azimuth, "elevation": (8, 55), "fov": 42}
    data = read_loaded(make_dataset(SCENES / f"{name}.xml", tmp_path, **tiny), "train")
    masks = [view.depth > 0 for view in data.views if view.depth is not None]
    assert len(masks) == 12 and all(mask.mean() > 0.03 for mask in masks)
    assert sum(mask.sum() > mask[1:-1, 1:-1].sum() for mask in masks) <= 1
    known = [view.materials["albedo"][..., -1] for view in data.views]
    np.testing.assert_array_equal(known, masks)  # each material is one that the method can represent


@pytest.fixture(scope="module")
def relit(made: Path) -> Path:
    """A copy of the data set with two lights more: one of the scene's size, one of another, both HDR."""
    folder = made.parent
    write_exr(folder / "warm.exr", sky(32))
    write_exr(folder / "cold sky.exr", 3 * sky(16)[:, ::-1, ::-1])
    out = folder / "relit"
    shutil.copytree(made, out)
    lights = [folder / "warm.exr", folder / "cold sky.exr"]
    return make_dataset(folder / "ball.xml", out, **OPTIONS, relight=lights)


def test_adding_lights_traces_no_other_views(relit: Path, made: Path, trace: Mock) -> None:
    folder, before = made.parent, contents(relit)
    assert before.items() >= {k: v for k, v in contents(made).items() if k != "dataset.json"}.items()
    for lights in (str(folder / "warm.exr"), ()):
        make_dataset(folder / "ball.xml", relit, **OPTIONS, relight=lights)
        assert not trace.called and contents(relit) == before  # the other lights stay, too
    assert set(json.loads(before["dataset.json"])["relight"]) == {"warm", "cold_sky"}


def test_relit_radiance_is_that_of_its_environment(relit: Path) -> None:
    """environment.exr of each light, in Mitsuba's orientation, accounts for the images under it."""
    for name in ("warm", "cold_sky"):
        data = read_loaded(relit / "relight" / name, "test", images="exr", background="black")
        assert data.environment is not None
        lit = mi.load_dict({"type": "scene", "e": {"type": "envmap", "filename": str(data.environment)}})
        check_brightness(data, read_loaded(relit, "test"), environment_image(lit, 16))


def test_replacement_light_is_rotated_like_the_scenes_own(made: Path, tmp_path: Path) -> None:
    """The scene's own map changes nothing; and a scene without a map is z up."""
    own = load_scene(made.parent / "ball.xml")
    same = under_light(own, SCENES / "lights" / "studio.exr")
    first, second = (environment_image(scene, 64) for scene in (own, same))
    np.testing.assert_array_equal(first, second)
    parts = '<emitter type="constant"/><emitter type="point"/><shape type="sphere"/>'
    (tmp_path / "plain.xml").write_text(f'<scene version="3.0.0">{parts}</scene>')
    light = np.full((16, 32, 3), 0.1, np.float32)
    light[:4] = 5  # the map's y, which becomes z
    write_exr(tmp_path / "top.exr", light)
    changed = under_light(load_scene(tmp_path / "plain.xml"), tmp_path / "top.exr")
    found = emitted(changed.environment(), np.array([[0, 0, 1], [0, 1, 0]]))
    np.testing.assert_allclose(found[:, 0], [5, 0.1], rtol=1e-5)
    assert len(changed.emitters()) == 1  # the lamp goes


def test_volumes_are_traced_and_a_map_beside_lamps_is_not_all_of_the_light(tmp_path: Path) -> None:
    fog = '<medium type="homogeneous" name="interior"><float name="sigma_t" value="3"/></medium>'
    parts = f'<emitter type="constant"/><emitter type="point"/><shape type="sphere"><bsdf type="null"/>{fog}'
    (tmp_path / "fog.xml").write_text(f'<scene version="3.0.0">{parts}</shape></scene>')
    data = read_loaded(make_dataset(tmp_path / "fog.xml", tmp_path / "fog", **OPTIONS), "train")
    assert data.environment is None
    assert all(view.alpha is not None and view.alpha.max() > 0.5 for view in data.views)


def test_parameters_of_a_scene_are_given(tmp_path: Path) -> None:
    """Those of its integrator need no value."""
    depth = '<integrator type="$how"><integer name="max_depth" value="$deep"/></integrator>'
    ball = '<emitter type="constant"/><shape type="sphere"><float name="radius" value="$r"/></shape>'
    (file := tmp_path / "a.xml").write_text(f'<scene version="3.0.0">{depth}{ball}</scene>')
    assert load_scene(file, ["r=2.5"]).bbox().max.x == 2.5
    assert scene_hash(file, ["r=1"]) != scene_hash(file, ["r=2"])
    refused(lambda: load_scene(file), "undefined parameter: $r", "-D NAME=VALUE")


def test_files_of_included_scenes_count(tmp_path: Path) -> None:
    """Beside the scene, beside what it includes, and in folders that it names; also if they include it."""
    file, place = tmp_path / "b.xml", '<path value="more"/><include filename="sub/c.XML"/>'
    file.write_text(f'<scene version="3.0.0">{place}</scene>')
    maps = [tmp_path / name for name in ("sky.exr", "sub/sky.exr", "more/sky.exr")]
    for path in maps:
        path.parent.mkdir(exist_ok=True)
        path.write_text("a")
    named = '<string name="filename" value="sky.exr"/><include filename="b.xml"/>'
    (tmp_path / "sub/c.XML").write_text(f'<scene version="3.0.0">{named}</scene>')
    assert len({scene_hash(file), *(scene_hash(file) for path in maps if path.write_text("b"))}) == 4
    refused(["dataset", file, "-o", tmp_path / "out", "-D", "r=1", "-D", "r"], "give NAME=VALUE")


def test_unusable_lights_are_refused(relit: Path, made: Path, tmp_path: Path) -> None:
    make: Any = partial(make_dataset, made.parent / "ball.xml", **OPTIONS)
    other, bad = tmp_path / "warm.exr", tmp_path / "bad.exr"
    other.write_bytes((made.parent / "cold sky.exr").read_bytes())
    refused(lambda: make(relit, relight=[other]), "dataset.json: --relight warm: ", "overwrite")
    refused(lambda: make(relit, relight=[other, made.parent / "warm.exr"]), "two have one name")
    bad.write_text("no image")
    refused(lambda: make(tmp_path / "out", relight=[bad]), "bad.exr")
    refused(lambda: make(tmp_path / "out", relight=[tmp_path / "none.exr"]), "none.exr")
    assert not (tmp_path / "out").exists()
