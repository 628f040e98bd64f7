"""Edits: exact rows, pictures of moved and joined things, meshes that follow, run folders."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from itertools import product
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.editing import Change, Selection, apply, assignments, edit, join, select
from mi_refgs.editing.expression import SurfelValues
from mi_refgs.editing.joining import joined_shading
from mi_refgs.editing.placement import rotated_sh
from mi_refgs.errors import InputError
from mi_refgs.io.images import write_png
from mi_refgs.reconstruction.reconstruction import load
from mi_refgs.reference.camera import look_at
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.options import QUALITY, TRACED, ShadingOptions
from mi_refgs.shade.reflectance import MODELS
from mi_refgs.shade.sh import eval_sh
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import SH_DC, logit
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer.pose import Pose
from tests.scenes.integrator import sky
from tests.scenes.known import CENTRES, RADII, known_mesh, known_surfels

SIZE = 48
METAL_BALL = "x < 0"
HALF = 3000  # surfels of each ball


def camera_at(pose: np.ndarray) -> Camera:
    return Camera.from_pose(SIZE, SIZE, -1.6 * SIZE, -1.6 * SIZE, SIZE / 2, SIZE / 2, pose, 0.01)


FRONT = look_at(np.array([0.3, -3.2, 0.7]), np.zeros(3))


def harmonics(count: int, degree: int, seed: int, size: float = 0.1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(scale=size, size=(count, 3 * (degree + 1) ** 2)).astype(np.float32)


def balls(light: Any = None, **shading: Any) -> TrainedScene:
    """A metal ball at x < 0 and one of clay, as surfels with their mesh; harmonics of a few degrees."""
    raw = known_surfels().to_numpy()
    raw["radiance_sh"] = harmonics(len(raw["position"]), 2, 1)
    raw["indirect_sh"] = harmonics(len(raw["position"]), 1, 2)
    light = EnvironmentLight.constant(0.8, 16) if light is None else light
    options: dict[str, Any] = {"diffuse": "sh", "occlusion": True} | shading
    return TrainedScene(Surfels.from_numpy(raw), light, known_mesh(), Shading(**options), 7, 1.5)


def picture(scene: TrainedScene, pose: np.ndarray = FRONT) -> np.ndarray:
    """Premultiplied linear RGBA (H·W, 4)."""
    frame = scene.renderer(aovs=False)(camera_at(pose))
    return np.stack([np.array(x, np.float64) for x in (*frame.radiance, frame.alpha)], axis=1)


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    mi.set_variant("llvm_ad_rgb")
    return balls()


# ---------------- which ----------------


@pytest.mark.parametrize(
    ("selection", "count"),
    [
        (Selection(), 2 * HALF),
        (Selection(where="metallic > 0.5"), HALF),
        (Selection(where="metallic > 0.5", invert=True), HALF),
        (Selection(where="metallic > 0.5 and metallic < 0.4 or roughness >= 0.45"), HALF),
        (Selection(where="0.1 < albedo.g < 0.58 and not opacity < 0.5"), HALF),
        (Selection(where="albedo.r > 0.5", box=(2, -2, -2, -2, 2, 2)), HALF),
        (Selection(box=(-1.1, -0.6, -0.6, 0.05, 0.6, 0.6)), HALF),
        (Selection(where="abs(sqrt((x + 0.5)**2 + y**2 + position.z**2) - 0.5) < 1e-4"), HALF),
        (Selection(where="max(albedo.r, albedo.g, albedo.b) == albedo.r"), HALF),
        (Selection(where="albedo.luminance > 0.5"), HALF),
        (Selection(nearest=(-5, 0, 0, 3)), HALF + HALF),
        (Selection(nearest=(-5, 0, 0, 0)), 1),
    ],
)
def test_known_rows_are_selected(scene: TrainedScene, selection: Selection, count: int) -> None:
    assert select(scene, selection).sum() == count


def test_names_are_the_activated_values(scene: TrainedScene) -> None:
    fields, raw = SurfelValues(scene), scene.surfels.to_numpy()
    ball = np.arange(2 * HALF) % 2
    outward = (raw["position"] - CENTRES[ball]) / RADII[ball, None]
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(fields[f"normal.{axis}"], outward[:, i], atol=1e-3)
        np.testing.assert_array_equal(fields[axis], raw["position"][:, i])
    np.testing.assert_allclose(fields["roughness"], np.where(ball == 0, 0.35, 0.5), rtol=1e-6)
    np.testing.assert_allclose(fields["size"], np.exp(raw["scale"]).max(1), rtol=1e-6)
    np.testing.assert_allclose(fields["colour.g"], 0.5 + 0.28209479 * raw["radiance_sh"][:, 1], rtol=1e-6)
    np.testing.assert_allclose(fields["luminance"], fields["colour.luminance"])
    assert {*fields} >= {"albedo.r", "opacity", "metallic", "x", "position.z", "luminance"}
    for name in fields:
        assert fields[name].shape == (2 * HALF,) and fields[name].dtype == np.float64


def test_the_nearest_is_measured_from_a_surfel(scene: TrainedScene) -> None:
    """From above the clay ball: its top, within r of which there is a cap of known area."""
    chosen = select(scene, Selection(nearest=(0.55, 0, 1, 0.2)))
    position = scene.surfels.to_numpy()["position"][chosen]
    assert np.linalg.norm(position - (0.55, 0, 0.35), axis=1).max() < 0.2 + 0.03
    expected = HALF * 0.2**2 / (4 * 0.45**2)  # a cap of chord r has the area π r²
    assert abs(len(position) - expected) < 0.1 * expected


def test_a_painted_mask_selects_what_is_in_front(scene: TrainedScene) -> None:
    """Painted is the left half of the picture: the half of one ball that faces the camera, all of it."""
    camera = camera_at(FRONT)
    row, column = np.mgrid[0:SIZE, 0:SIZE]
    raw = scene.surfels.to_numpy()
    origin = FRONT[:3, 3]
    ball = np.arange(2 * HALF) % 2
    outward = (raw["position"] - CENTRES[ball]) / RADII[ball, None]
    towards = origin - raw["position"]
    facing = np.sum(outward * towards, axis=1) / np.linalg.norm(towards, axis=1)
    local = (raw["position"] - origin) @ FRONT[:3, :3]
    pixel = -1.6 * SIZE * local[:, :2] / local[:, 2:] + SIZE / 2
    mask = (column - 16) ** 2 + (row - 24) ** 2 < 6**2
    chosen = select(scene, Selection(mask=mask, camera=camera))
    inside = (pixel[:, 0] - 16.5) ** 2 + (pixel[:, 1] - 24.5) ** 2
    assert chosen[(inside < 5**2) & (facing > 0.2)].mean() > 0.99
    assert not chosen[facing < -0.2].any() and not chosen[inside > 7.5**2].any()
    with pytest.raises(InputError, match=r"--mask: 3 × 2 pixels, but the view has 48 × 48"):
        select(scene, Selection(mask=np.ones((2, 3), bool), camera=camera))


# ---------------- materials ----------------


def test_new_values_are_exact_and_others_stay_bit_for_bit(scene: TrainedScene) -> None:
    before, fields = scene.surfels.to_numpy(), SurfelValues(scene)
    given = {"roughness": 0.25, "metallic": 0, "albedo": (0.9, 0.6, "0.5 * albedo.b"), "opacity": "opacity"}
    edited = edit(scene, where=METAL_BALL, set=given)
    assert (edited.record["selected"], edited.record["of"]) == (HALF, 2 * HALF)
    after, now = edited.scene.surfels.to_numpy(), SurfelValues(edited.scene)
    chosen = before["position"][:, 0] < 0
    for name in before:
        np.testing.assert_array_equal(before[name][~chosen], after[name][~chosen])
    for name in ("position", "rotation", "scale", "radiance_sh", "indirect_sh"):
        np.testing.assert_array_equal(before[name], after[name])
    np.testing.assert_allclose(now["roughness"][chosen], 0.25, rtol=1e-6)
    np.testing.assert_allclose(now["metallic"][chosen], 0, atol=2e-6)
    np.testing.assert_allclose(now["albedo.g"][chosen], 0.6, rtol=1e-6)
    np.testing.assert_allclose(now["albedo.b"][chosen], 0.5 * fields["albedo.b"][chosen], rtol=1e-5)
    np.testing.assert_allclose(now["opacity"], fields["opacity"], rtol=1e-6)
    assert edited.scene.mesh is scene.mesh


def test_products_and_single_columns(scene: TrainedScene) -> None:
    fields = SurfelValues(scene)
    now = SurfelValues(edit(scene, set=["albedo*=1,0.5,0", "roughness*=3", "albedo.r=0.125"]).scene)
    np.testing.assert_allclose(now["albedo.r"], 0.125, rtol=1e-6)
    np.testing.assert_allclose(now["albedo.g"], 0.5 * fields["albedo.g"], rtol=1e-5)
    np.testing.assert_allclose(now["roughness"], np.minimum(3 * fields["roughness"], 1), rtol=1e-5)


def test_a_colour_scales_all_harmonics(scene: TrainedScene) -> None:
    """Radiance only: twice the colour is twice the picture; a new one has the same view dependence."""
    plain = replace(balls(reflectance="radiance", occlusion=False), mesh=None)
    doubled = edit(plain, set=["colour*=0.5"]).scene
    np.testing.assert_allclose(picture(doubled)[:, :3], 0.5 * picture(plain)[:, :3], atol=1e-5)
    before = plain.surfels.to_numpy()["radiance_sh"]
    after = edit(plain, set={"colour": (0.2, 0.3, 0.4)}).scene.surfels.to_numpy()["radiance_sh"]
    np.testing.assert_allclose(0.5 + SH_DC * after[:, :3], np.tile((0.2, 0.3, 0.4), (2 * HALF, 1)), rtol=1e-5)
    ratio = (0.2, 0.3, 0.4) / (0.5 + SH_DC * before[:, :3])
    np.testing.assert_allclose(after[:, 3:6], before[:, 3:6] * ratio, rtol=1e-4)
    one = edit(plain, set=["colour.g=0.7"]).scene.surfels.to_numpy()["radiance_sh"]
    np.testing.assert_array_equal(one[:, [0, 2, 3, 5]], before[:, [0, 2, 3, 5]])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"set": ["shininess=1"]}, "'shininess' cannot be set of these surfels; use one of opacity, albedo"),
        ({"set": ["x=1"]}, "'x' cannot be set"),
        ({"set": ["roughness=1.5"]}, "1.5 … 1.5 is out of range; give 0 to 1"),
        ({"set": ["colour=-1"]}, "give 0 or more"),
        ({"set": ["albedo=1,2"]}, "2 values; give 1 or 3"),
        ({"set": ["roughness"]}, "no assignment; write it like roughness=0.3"),
        ({"set": ["roughness==1"]}, "no assignment"),
        ({"set": ["roughness=0.2 albedo=1"]}, "several assignments in one; quote each one"),
        ({"set": ["roughness=0.2, albedo.r *= 0.5"]}, "several assignments in one"),
        ({"set": ["roughness=x>0"]}, "a comparison is no number"),
        ({"set": ["roughness=0/0"]}, "not a finite number for every surfel"),
        ({"set": ["roughness=shine"]}, "'shine' is no value of these surfels; use one of position.x"),
        ({"where": "shine > 1", "cut": True}, "--where: 'shine' is no value of these surfels"),
        ({"where": "x > 100", "cut": True}, "none of the 6000 surfels is in it; choose a wider one"),
        ({"cut": True}, "--cut: no surfel would be left"),
        ({"cut": True, "where": "x>0", "move": (1, 0, 0)}, "what is removed cannot be changed"),
        ({}, "nothing to do"),
        ({"scale": 0.0}, "--scale: 0 is out of range"),
        ({"scale": float("nan")}, "--scale: nan is out of range"),
        ({"move": (1, 2)}, "--move: 3 finite numbers are needed"),
        ({"move": (1e30, 0, 0)}, "--move: 3 finite numbers are needed, none beyond 1e+09"),
        ({"move": "far"}, "--move: 3 finite numbers are needed"),
        ({"rotate": ("z",)}, "--rotate: ('z',): not an axis and an angle"),
        ({"rotate": "z"}, "--rotate: 'z': not an axis and an angle"),
        ({"rotate": ("w", 90)}, "--rotate: 'w': no axis"),
        ({"rotate": ("0,0,0", 90)}, "--rotate: an axis without length"),
        ({"rotate": ("z", "much")}, "--rotate: 'much': no angle"),
        ({"box": (0, 0, 0, 1, 1, float("inf")), "cut": True}, "--box: 6 finite numbers"),
        ({"nearest": (0, 0, 0, -1), "cut": True}, "--nearest: the distance -1 is negative"),
        ({"wehre": "x > 0", "set": ["roughness=1"]}, "edit: wehre: unknown option; use some of where, box"),
    ],
)
def test_what_makes_no_sense_is_one_sentence(
    scene: TrainedScene, given: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError) as caught:
        edit(scene, **given)
    assert message in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [["--where", "x >"], ["--set", "roughness"]])
def test_a_formula_is_refused_before_the_run_is_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], wrong: list[str]
) -> None:
    """The run is not even there."""
    assert main(["edit", str(tmp_path / "none"), "-o", str(tmp_path / "new"), *wrong]) == 2
    assert capsys.readouterr().err.startswith(f"refgs: {wrong[0]}: ")


def test_arrays_do_as_well_as_lists(scene: TrainedScene) -> None:
    """What a notebook has at hand; the record of an edit is the same."""
    given: dict[str, list[float]] = {
        "box": [-2, -2, -2, 0, 2, 2],
        "nearest": [-1, 0, 0, 0.5],
        "move": [0.5, 0, 0],
        "duplicate": [0, 0, 1],
    }
    ways: tuple[Any, ...] = (list, np.array)
    every: list[dict[str, Any]] = [{name: way(value) for name, value in given.items()} for way in ways]
    turns = [(way([0.0, 0.0, 1.0]), 90) for way in ways]
    lists, arrays = (edit(scene, rotate=turn, **one) for turn, one in zip(turns, every, strict=True))
    assert lists.record == json.loads(json.dumps(arrays.record))
    for name, table in lists.scene.surfels.to_numpy().items():
        np.testing.assert_array_equal(arrays.scene.surfels.to_numpy()[name], table)


# ---------------- places ----------------


def test_harmonics_turn_exactly(rng: np.random.Generator) -> None:
    """The turned function at d is the old one at R⁻¹ d, of every degree."""
    direction = rng.normal(size=(50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    turn = Rotation.from_rotvec([0.7, -1.1, 2.2])
    for degree in range(4):
        raw = harmonics(1, degree, 5, 1.0)
        turned = rotated_sh(raw, turn)

        def at(coefficients: np.ndarray, d: np.ndarray) -> np.ndarray:
            colours = [mi.Color3f(*map(float, row)) for row in coefficients.reshape(-1, 3)]
            return np.array(eval_sh(colours, mi.Vector3f(d.T)), np.float64)

        np.testing.assert_allclose(at(turned, direction), at(raw, turn.inv().apply(direction)), atol=2e-5)


PLACEMENTS: list[dict[str, Any]] = [
    {"move": (0.4, -0.2, 0.3)},
    {"rotate": ("0.3,-1,0.5", 70), "move": (0.1, 0, 0)},
    {"scale": 2.0},
    {"rotate": ("z", 200), "scale": 0.5},
]


@pytest.mark.parametrize("placement", PLACEMENTS)
@pytest.mark.parametrize("diffuse", ["sh", "irradiance"])
def test_a_moved_scene_is_the_view_of_the_camera_moved_back(placement: dict[str, Any], diffuse: str) -> None:
    """Under a light that is the same from everywhere; mirrors, shadows and fitted harmonics included."""
    rays: dict[str, Any] = (
        {"ambient_rays": 32, "visibility_rays": 4, "traced_bounces": 1} if diffuse == "irradiance" else {}
    )
    scene = balls(diffuse=diffuse, **rays)
    change = Change(**placement)
    moved = apply(scene, np.ones(2 * HALF, bool), change)
    place = change.placement(scene.surfels.to_numpy())
    pose = FRONT.copy()
    pose[:3, :3] = place.rotation.as_matrix() @ FRONT[:3, :3]
    pose[:3, 3] = place.points(FRONT[None, :3, 3])[0]
    before, after = picture(scene), picture(moved, pose)
    assert before[:, 3].max() > 0.99 and np.ptp(before[:, 0]) > 0.2
    # Few pixels at outlines change sides by rounding; rays of a turned frame are other samples of the same.
    limit = 0.02 if rays else 2e-3
    assert np.mean(np.abs(after - before).max(axis=1) > limit) < 0.02
    assert np.abs(after - before).mean() < 0.1 * limit


def test_gaussians_are_turned_and_grow_as_surfels_do() -> None:
    raw = balls(reflectance="radiance", occlusion=False).surfels.to_numpy()
    raw["scale"] = np.concatenate([raw["scale"], raw["scale"][:, :1] - 2], axis=1)
    scene = replace(balls(reflectance="radiance", occlusion=False), surfels=Surfels.from_numpy(raw))
    change = Change(rotate=("1,2,3", 130), scale=1.5, move=(0.5, 0, 0))
    place = change.placement(raw)
    pose = FRONT.copy()
    pose[:3, :3] = place.rotation.as_matrix() @ FRONT[:3, :3]
    pose[:3, 3] = place.points(FRONT[None, :3, 3])[0]
    after = picture(apply(scene, np.ones(2 * HALF, bool), change), pose)
    np.testing.assert_allclose(after, picture(scene), atol=2e-3)


def test_a_turned_normal_offset_and_a_zero_quaternion(scene: TrainedScene) -> None:
    raw = scene.surfels.to_numpy()
    raw["normal_offset"] = harmonics(2 * HALF, 0, 3)
    raw["rotation"][0] = 0
    turned = apply(
        replace(scene, surfels=Surfels.from_numpy(raw)),
        np.ones(2 * HALF, bool),
        Change(rotate=("x", 90)),
    ).surfels.to_numpy()
    x, y, z = raw["normal_offset"].T
    np.testing.assert_allclose(turned["normal_offset"], np.stack([x, -z, y], axis=1), atol=1e-7)
    half = np.sqrt(0.5)
    np.testing.assert_allclose(turned["rotation"][0], (half, 0, 0, half), atol=1e-7)


def test_a_turn_and_its_opposite_leave_everything_as_it_was(scene: TrainedScene) -> None:
    there = edit(scene, where="z > 0.1", rotate=("1,2,3", 77), scale=2.0, move=(1, 0, 0)).scene
    chosen = SurfelValues(scene)["z"] > 0.1
    back = apply(there, chosen, Change(rotate=("1,2,3", -77), scale=0.5, move=(-1, 0, 0)))
    for name, table in scene.surfels.to_numpy().items():
        now = back.surfels.to_numpy()[name]
        sign = np.sign(np.sum(now * table, axis=1, keepdims=True)) if name == "rotation" else 1
        np.testing.assert_allclose(sign * now, table, atol=2e-5)


def test_only_the_selected_ball_and_its_triangles_move(scene: TrainedScene) -> None:
    moved = edit(scene, where=METAL_BALL, move=(0, 0, 3), scale=2.0).scene
    before, after = scene.surfels.to_numpy(), moved.surfels.to_numpy()
    chosen = before["position"][:, 0] < 0
    for name in before:
        np.testing.assert_array_equal(before[name][~chosen], after[name][~chosen])
    middle = before["position"][chosen].astype(np.float64).mean(axis=0)
    expected = 2 * (before["position"][chosen] - middle) + middle + (0, 0, 3)
    np.testing.assert_allclose(after["position"][chosen], expected, atol=1e-5)
    np.testing.assert_allclose(np.exp(after["scale"] - before["scale"])[chosen], 2, rtol=1e-5)
    assert moved.mesh is not None and scene.mesh is not None
    assert len(moved.mesh.faces) == len(scene.mesh.faces) and moved.mesh.voxel == 2 * scene.mesh.voxel
    high = moved.mesh.vertices[:, 2] > 1
    assert high.sum() == len(high) / 2 == (moved.mesh.vertices[:, 2] < 0.5).sum()
    np.testing.assert_allclose(np.linalg.norm(moved.mesh.vertices[high] - (-0.5, 0, 3), axis=1), 1, atol=0.02)


def test_a_view_that_sees_nothing_has_nothing_painted(scene: TrainedScene) -> None:
    away = edit(scene, move=(1e4, 0, 0)).scene
    with pytest.raises(InputError, match="none of the 6000 surfels is in it"):
        edit(away, camera=camera_at(FRONT), mask=np.ones((SIZE, SIZE), bool), cut=True)


def test_cut_removes_a_ball_and_its_shadow_and_mirror_image() -> None:
    """What is left is the picture of the other ball alone, mesh and all."""
    light = EnvironmentLight.from_radiance(sky(16))
    rays = {"ambient_rays": 32, "visibility_rays": 4, "traced_bounces": 1}
    whole = balls(light, diffuse="irradiance", **rays)
    left = edit(whole, where=METAL_BALL, keep=True).scene
    cut = edit(whole, where=METAL_BALL, cut=True, invert=True).scene
    assert left.surfels.count == cut.surfels.count == HALF
    mesh = known_mesh()
    alone = replace(left, mesh=mesh.part(mesh.vertices[mesh.faces].mean(axis=1)[:, 0] < 0))
    for scene in (left, cut):
        assert scene.mesh is not None and len(scene.mesh.faces) == len(mesh.faces) / 2
        np.testing.assert_allclose(picture(scene), picture(alone), atol=1e-6)
    ghost = replace(left, mesh=mesh)
    assert np.abs(picture(ghost) - picture(alone)).max() > 0.05


def test_surroundings_stay_with_their_triangles() -> None:
    """Of an object and a wall around it, the object's triangles alone are moved, cut and kept."""
    whole = balls()
    raw = whole.surfels.to_numpy()
    chosen = raw["position"][:, 0] < 0
    geometry = ("position", "rotation", "scale", "opacity", "radiance_sh")
    wall = Surroundings(Surfels.from_numpy({name: raw[name][~chosen] for name in geometry}))
    object_ = Surfels.from_numpy({name: table[chosen] for name, table in raw.items()})
    scene = replace(whole, surfels=object_, surroundings=wall)
    assert scene.mesh is not None
    of_wall = scene.mesh.vertices[scene.mesh.vertices[:, 0] > 0.05]
    moved = edit(scene, move=(0, 0, 9)).scene
    assert moved.surroundings is wall and moved.mesh is not None
    joined, told = join(replace(whole, mesh=None), scene)
    assert joined.mesh is not None and len(joined.mesh.faces) == len(scene.mesh.faces) / 2
    assert joined.surroundings is None and "the background of the joined run is left out" in told
    high = moved.mesh.vertices[:, 2] > 5
    assert high.sum() == len(scene.mesh.vertices) / 2
    np.testing.assert_array_equal(np.sort(moved.mesh.vertices[~high], axis=0), np.sort(of_wall, axis=0))
    for half in (edit(scene, where="z > 0", keep=True), edit(scene, where="z > 0", cut=True)):
        mesh = half.scene.mesh
        assert mesh is not None and len(mesh.faces) / len(scene.mesh.faces) == pytest.approx(0.75, abs=0.02)
        assert (mesh.vertices[:, 0] > 0.05).sum() == len(of_wall)


def test_what_is_made_transparent_leaves_the_mesh(scene: TrainedScene) -> None:
    assert scene.mesh is not None
    for opacity, kept in ((0.6, 1.0), (0.3, 0.5), (0.0, 0.5)):
        mesh = edit(scene, where=METAL_BALL, set={"opacity": opacity}).scene.mesh
        assert mesh is not None and len(mesh.faces) == kept * len(scene.mesh.faces)


def test_a_duplicate_takes_the_changes_and_the_original_stays(scene: TrainedScene) -> None:
    edited = edit(scene, where=METAL_BALL, duplicate=(0, 5, 0), set=["roughness=0.75"], rotate=("z", 90))
    before, after = scene.surfels.to_numpy(), edited.scene.surfels.to_numpy()
    assert edited.record["selected"] == HALF and edited.scene.surfels.count == 3 * HALF
    for name in before:
        np.testing.assert_array_equal(before[name], after[name][: 2 * HALF])
    np.testing.assert_allclose(SurfelValues(edited.scene)["roughness"][2 * HALF :], 0.75, rtol=1e-6)
    np.testing.assert_allclose(after["position"][2 * HALF :].mean(axis=0), (-0.5, 5, 0), atol=5e-3)
    assert edited.scene.mesh is not None and scene.mesh is not None
    assert len(edited.scene.mesh.faces) == 1.5 * len(scene.mesh.faces)
    np.testing.assert_array_equal(edited.scene.mesh.faces[: len(scene.mesh.faces)], scene.mesh.faces)


# ---------------- two runs ----------------


def test_two_halves_joined_are_the_whole() -> None:
    light = EnvironmentLight.from_radiance(sky(16))
    rays = {"ambient_rays": 32, "visibility_rays": 4, "traced_bounces": 1}
    whole = balls(light, diffuse="irradiance", **rays)
    first, second = (
        edit(whole, where=METAL_BALL, keep=True, invert=invert).scene for invert in (False, True)
    )
    joined, told = join(first, replace(second, light=EnvironmentLight.constant(5.0, 8)))
    assert told == ["the light is that of RUN"] and joined.surfels.count == 2 * HALF
    np.testing.assert_allclose(picture(joined), picture(whole), atol=2e-3)
    assert np.abs(picture(joined) - picture(first)).max() > 0.2


@pytest.mark.parametrize(
    "option", [f for f in fields(ShadingOptions) if f.name in QUALITY], ids=lambda option: option.name
)
def test_shading_options_of_joined_runs_are_those_of_the_first(option: Any) -> None:
    """Whichever of the two traces rays; the options of rays are of the one that traces."""
    model = next(model for model in MODELS.values() if option.name in model.honours)
    of_rays = option.name in TRACED
    other = not option.default if isinstance(option.default, bool) else option.default + 1
    other = option.default - 1 if option.name == "light_levels" else other

    def shading(occlusion: bool, value: Any) -> Shading:
        value = option.default if of_rays and not occlusion else value
        return Shading(model.orders[0], model.name, "irradiance", occlusion, **{option.name: value})

    traces = [True, False] if model.visibility != "none" else [False]
    for pair, values in product(product(traces, traces), ((option.default, other), (other, option.default))):
        first, second = (shading(*each) for each in zip(pair, values, strict=True))
        joined = joined_shading(first, second)
        assert joined.occlusion == any(pair)
        owner = second if of_rays and pair == (False, True) else first
        assert getattr(joined, option.name) == getattr(owner, option.name)


def test_a_joined_run_that_traces_keeps_the_options_of_the_first(scene: TrainedScene) -> None:
    first = replace(scene, mesh=None, shading=replace(scene.shading, occlusion=False))
    assert scene.shading.occlusion
    joined, _ = join(replace(first, shading=replace(first.shading, multiscatter=True, light_levels=4)), scene)
    assert joined.shading == replace(scene.shading, multiscatter=True, light_levels=4)


def test_harmonics_that_one_run_lacks_change_neither(scene: TrainedScene) -> None:
    """Of another degree, or none: pictures of what does not meet stay as they are."""
    raw = edit(scene, where=METAL_BALL, keep=True).scene.surfels.to_numpy()
    second = {name: table for name, table in raw.items() if name != "indirect_sh"}
    second["radiance_sh"] = second["radiance_sh"][:, :12]
    lesser = replace(scene, surfels=Surfels.from_numpy(second), mesh=None)
    far = edit(scene, where=METAL_BALL, cut=True, move=None).scene
    joined, told = join(far, edit(lesser, move=(0, 0, 50)).scene)
    assert joined.surfels.raw["radiance_sh"].shape == (2 * HALF, 27)
    assert any("has no mesh" in note for note in told)
    np.testing.assert_allclose(picture(joined), picture(far), atol=1e-6)
    above = FRONT.copy()
    above[2, 3] += 50
    alone = replace(lesser, shading=replace(lesser.shading, occlusion=False))
    np.testing.assert_allclose(picture(joined, above), picture(alone), atol=2e-3)


def test_runs_that_do_not_fit_together_are_refused(scene: TrainedScene) -> None:
    other = balls(diffuse="irradiance")
    with pytest.raises(
        InputError, match=r"diffuse: 'sh' and 'irradiance' are not shaded alike; make both mat"
    ):
        join(scene, other)
    raw = other.surfels.to_numpy()
    gaussians = {**raw, "scale": raw["scale"][:, [0, 0, 0]]}
    with pytest.raises(InputError, match="one has surfels, the other gaussians"):
        join(other, replace(other, surfels=Surfels.from_numpy(gaussians)))
    tinted = {**raw, "tint": raw["albedo"]}
    with pytest.raises(InputError, match="tint: one of the runs has no such attribute"):
        join(other, replace(other, surfels=Surfels.from_numpy(tinted)))


def test_materials_alone_can_be_joined() -> None:
    first, second = balls(), balls(diffuse="irradiance")
    edited = edit(second, materials=True, move=(3, 0, 0), into=first)
    assert edited.scene.shading.diffuse == "irradiance" and edited.scene.surfels.count == 4 * HALF
    assert edited.record["selected"] == edited.record["of"] == 2 * HALF


# ---------------- notes ----------------


def test_what_stays_as_fitted_is_said(scene: TrainedScene) -> None:
    assert edit(scene, set=["roughness=0.1"]).notes == ()
    metal = edit(scene, set=["metallic=1"]).notes
    assert any("albedo and metallic change what is reflected" in note for note in metal)
    moved = edit(scene, where=METAL_BALL, move=(1, 0, 0)).notes
    assert any("keeps the light of the place" in note for note in moved)
    plain = balls(reflectance="radiance", occlusion=False)
    assert any("metallic: no image of this run depends" in n for n in edit(plain, set=["metallic=1"]).notes)
    assert edit(balls(diffuse="irradiance", occlusion=False), set=["metallic=1"]).notes == ()


# ---------------- run folders ----------------


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_an_edited_run_is_a_run(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An edit of an edit; every command reads it; the run that it came from stays as it was."""
    before = files(finished)
    new, newer = tmp_path / "new", tmp_path / "newer"
    options = ["--set", "roughness=0.5", "--where", "x > 0", "--preview"]
    assert main(["edit", str(finished), "-o", str(new), *options]) == 0
    out = capsys.readouterr().out
    assert main(["edit", str(new), "-o", str(newer), "--move", "0", "0", "0.125", "--json"]) == 0
    second = json.loads(capsys.readouterr().out)
    assert files(finished) == before
    assert not (new / "checkpoints").exists() and (new / "preview.png").stat().st_size > 1000
    record = json.loads((newer / "edit.json").read_text())["edits"]
    assert [edit["selected"] == edit["of"] for edit in record] == [False, True]
    assert record[0]["where"] == "x > 0" and record[0]["set"] == ["roughness=0.5"]
    assert f"{record[0]['selected']} of {record[0]['of']} surfels" in out and second["move"] == [0, 0, 0.125]
    scenes = [TrainedScene.read(folder) for folder in (finished, new, newer)]
    raw = [scene.surfels.to_numpy() for scene in scenes]
    chosen = raw[0]["position"][:, 0] > 0
    assert chosen.sum() == record[0]["selected"]
    np.testing.assert_allclose(raw[1]["roughness"][chosen], logit(0.5), atol=1e-6)
    np.testing.assert_array_equal(raw[1]["roughness"][~chosen], raw[0]["roughness"][~chosen])
    np.testing.assert_array_equal(raw[2]["roughness"], raw[1]["roughness"])
    np.testing.assert_allclose(raw[2]["position"], raw[0]["position"] + (0, 0, 0.125), atol=1e-6)
    for command in (["eval", str(newer)], ["export", str(newer)]):
        assert main(command) == 0
    assert main(["render", str(newer), "-o", str(tmp_path / "out.png")]) == 0


def test_masks_and_views(
    finished: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mask = np.zeros((40, 40, 3))
    mask[:, 20:] = 1
    write_png(tmp_path / "mask.png", mask)
    command = ["edit", str(finished), "--mask", str(tmp_path / "mask.png"), "--set", "roughness=1"]
    assert main([*command, "-o", str(tmp_path / "half"), "--view", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert 0 < found["selected"] < found["of"] / 2
    for extra, message in (
        (["--view", "2"], "camera: 2: test has 2; give 0 to 1"),
        (["--split", "train", "--view", "3"], "train has 3; give 0 to 2"),
    ):
        assert main([*command, "-o", str(tmp_path / "none"), *extra]) == 2
        assert message in capsys.readouterr().err
    camera = tmp_path / "view_000.json"  # as the page saves it
    pose = Pose.of_view(read_dataset(data, "test").views[1])
    camera.write_text(json.dumps(pose.transforms(20, 20, "view_000")))
    assert main([*command, "-o", str(tmp_path / "saved"), "--view", str(camera), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["selected"] == found["selected"]
    camera.write_text("{}")
    assert main([*command, "-o", str(tmp_path / "none"), "--view", str(camera)]) == 2
    assert "view_000.json: frames: missing" in capsys.readouterr().err
    write_png(tmp_path / "mask.png", mask[:15])
    assert main([*command, "-o", str(tmp_path / "none")]) == 2
    assert "mask.png: mask: 40 × 15 pixels, but the view has 20 × 20" in capsys.readouterr().err
    write_png(tmp_path / "mask.png", 0 * mask)
    assert main([*command, "-o", str(tmp_path / "none")]) == 2
    assert "no pixel is painted white" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_joined_runs_and_previews_without_data(
    finished: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    new, newer = tmp_path / "new", tmp_path / "newer"
    move = ["--move", "2", "0", "-0e-1"]
    assert main(["edit", str(finished), "-o", str(new), "--join", str(finished), *move, "--json"]) == 0
    out = capsys.readouterr()
    found = json.loads(out.out)
    assert found["surfels"] == 2 * found["of"] == 2 * found["selected"]
    assert "note: the light is that of RUN" in out.err
    position = TrainedScene.read(new).surfels.to_numpy()["position"]
    first, second = np.split(position, 2)
    np.testing.assert_allclose(second - first, np.tile((2, 0, 0), (len(first), 1)), atol=1e-6)
    (new / "dataset.json").unlink()
    assert main(["edit", str(new), "-o", str(newer), *move, "--preview"]) == 0
    assert (newer / "preview.png").is_file() and not (newer / "dataset.json").exists()
    again = ["edit", str(newer), "-o", str(tmp_path / "again"), "--rotate", "-1,0,0", "-90"]
    assert main([*again, "--data", str(data)]) == 0
    assert main(["eval", str(tmp_path / "again")]) == 0


def test_a_reconstruction_is_edited_alike(finished: Path, tmp_path: Path) -> None:
    whole = load(finished, write=False)
    red = whole.edit(where="x > 0", set={"albedo": (1, 0, 0)}, move=(0, 0, 1))
    both = red.edit(join=whole, keep=True, where="x < 0").edit(
        mask=np.ones((20, 20), bool), view=whole.camera(1), cut=True
    )
    assert whole.provenance.edits == () and red.folder is None
    first, second, third = both.provenance.edits
    assert (first["where"], second["where"], third.get("where")) == ("x > 0", "x < 0", None)
    assert second["of"] == whole.trained.surfels.count == first["of"]
    assert first["selected"] + second["selected"] <= first["of"]
    assert third["of"] == second["surfels"] == first["of"] + second["selected"]
    assert both.trained.surfels.count == third["of"] - third["selected"]
    again = both.save(tmp_path / "new")
    assert list(again.provenance.edits) == json.loads(json.dumps(both.provenance.edits))
    with pytest.raises(InputError, match="camera: 2: test has 2; give 0 to 1"):
        whole.edit(mask=np.ones((20, 20), bool), view=2, cut=True)


def test_an_edited_run_is_no_fit_to_go_on_with(
    finished: Path, data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Training would replace what was edited."""
    new = tmp_path / "new"
    assert main(["edit", str(finished), "-o", str(new), "--set", "roughness=0.5"]) == 0
    before = files(new)
    assert main(["train", str(data), "-o", str(new), "--resume"]) == 2
    assert "checkpoints: none, but a scene that was edited" in capsys.readouterr().err
    assert files(new) == before


def test_bad_commands_leave_nothing(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new"
    for options, message in (
        ([], "nothing to do"),
        (["--set", "roughness=0.5", "--where", "x > 1e9"], "choose a wider one"),
        (["--set", "roughness=0.5", "--where", "__import__('os')"], "character"),
        (["--join", str(tmp_path / "none"), "--move", "1", "0", "0"], "config.toml: missing"),
        (["--cut", "--keep"], "not allowed with"),
        (["--cut", "--data", str(tmp_path / "none")], "--data: no such folder"),
        (["--move", "-1e999", "0", "-1e-3"], "--move: 3 finite numbers are needed"),
        (["--rotate", "-1,0", "-90"], "--rotate: '-1,0': no axis"),
    ):
        assert main(["edit", str(finished), "-o", str(out), *options]) == 2
        error = capsys.readouterr().err
        assert message in error and error.count("\n") == 1
        assert not any(tmp_path.iterdir())
    for taken in (finished, tmp_path):
        (tmp_path / "something").touch()
        assert main(["edit", str(finished), "-o", str(taken), "--set", "roughness=1"]) == 2
        assert "stands there already; choose another -o" in capsys.readouterr().err


def test_assignments_of_texts_and_of_values_are_one() -> None:
    texts = assignments(["roughness=0.5", "albedo=0.1,x,2*y"])
    values = assignments({"roughness": 0.5, "albedo": (0.1, "x", "2*y")})
    for a, b in zip(texts, values, strict=True):
        assert a.name == b.name and [e.names for e in a.values] == [e.names for e in b.values]
