"""Edits: exact surfels, meshes, run folders."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.editing.change import edit
from mi_refgs.editing.options import Selection
from mi_refgs.editing.selection import SurfelValues, select
from mi_refgs.reconstruction.reconstruction import load
from mi_refgs.reference.camera import look_at
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.near_field import NearField
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import SH_DC, logit
from mi_refgs.surfels.table import Surfels
from tests.helpers import contents, refused
from tests.scenes.integrator import sky
from tests.scenes.known import CENTRES, RADII, known_mesh, known_surfels, with_background

SIZE = 48
METAL_BALL = "x < 0"
HALF = 3000  # surfels of each ball
FRONT = look_at(np.array([0.3, -3.2, 0.7]), np.zeros(3))


def balls(light: Any = None, **shading: Any) -> TrainedScene:
    """A metal ball at x < 0 and one of clay, as surfels with their mesh and SH of a few degrees."""
    raw = known_surfels().to_numpy()
    for seed, (name, columns) in enumerate({"radiance_sh": 27, "indirect_sh": 12}.items(), 1):
        raw[name] = np.random.default_rng(seed).normal(0, 0.1, (2 * HALF, columns)).astype(np.float32)
    light = EnvironmentLight.constant(0.8, 16) if light is None else light
    options: dict[str, Any] = {"diffuse": "sh", "occlusion": True} | shading
    return TrainedScene(Surfels.from_numpy(raw), light, known_mesh(), Shading(**options), 7, 1.5)


def image(scene: TrainedScene) -> np.ndarray:
    """Premultiplied linear RGBA (H·W, 4)."""
    camera = Camera.from_pose(SIZE, SIZE, -1.6 * SIZE, -1.6 * SIZE, SIZE / 2, SIZE / 2, FRONT, 0.01)
    frame = scene.renderer(aovs=False)(camera)
    return np.stack([np.array(x, np.float64) for x in (*frame.radiance, frame.alpha)], axis=1)


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    return balls()


@pytest.mark.parametrize(
    ("selection", "count"),
    [
        (Selection(), 2 * HALF),
        (Selection(where="metallic > 0.5"), HALF),
        (Selection(where="metallic > 0.5", invert=True), HALF),
        (Selection(where="metallic > 0.5 and metallic < 0.4 or roughness >= 0.45"), HALF),
        (Selection(where="albedo.g > 0.1 and albedo.g <= 5.8e-1 and opacity >= .5"), HALF),
        (Selection(where="albedo.r > 0.5", box=(2, -2, -2, -2, 2, 2)), HALF),
        (Selection(box=(-1.1, -0.6, -0.6, 0.05, 0.6, 0.6)), HALF),
    ],
)
def test_select_returns_known_surfels(scene: TrainedScene, selection: Selection, count: int) -> None:
    assert select(scene, selection).sum() == count


def test_values_are_activated_attributes(scene: TrainedScene) -> None:
    fields, raw = SurfelValues(scene), scene.surfels.to_numpy()
    ball = np.arange(2 * HALF) % 2
    outward = (raw["position"] - CENTRES[ball]) / RADII[ball, None]
    for i, axis in enumerate("xyz"):
        np.testing.assert_allclose(fields[f"normal.{axis}"], outward[:, i], atol=1e-3)
        np.testing.assert_array_equal(fields[axis], raw["position"][:, i])
    np.testing.assert_allclose(fields["roughness"], np.where(ball == 0, 0.35, 0.5), rtol=1e-6)
    np.testing.assert_allclose(fields["size"], np.exp(raw["scale"]).max(1), rtol=1e-6)
    np.testing.assert_allclose(fields["colour.g"], 0.5 + 0.28209479 * raw["radiance_sh"][:, 1], rtol=1e-6)
    assert {*fields.names} >= {"albedo.r", "opacity", "metallic", "x", "position.z", "size"}
    for name in fields.names:
        assert fields[name].shape == (2 * HALF,) and fields[name].dtype == np.float64


def test_set_is_exact_and_other_surfels_stay_bit_for_bit(scene: TrainedScene) -> None:
    before = scene.surfels.to_numpy()
    given = {"roughness": 0.25, "metallic": 0, "albedo": (0.9, 0.6, 0.1)}
    edited, record = edit(scene, where=METAL_BALL, set=given)
    assert (record["selected"], record["of"]) == (HALF, 2 * HALF)
    after, now = edited.surfels.to_numpy(), SurfelValues(edited)
    chosen = before["position"][:, 0] < 0
    for name in before:
        np.testing.assert_array_equal(before[name][~chosen], after[name][~chosen])
    for name in ("position", "rotation", "scale", "radiance_sh", "indirect_sh"):
        np.testing.assert_array_equal(before[name], after[name])
    np.testing.assert_allclose(now["roughness"][chosen], 0.25, rtol=1e-6)
    np.testing.assert_allclose(now["metallic"][chosen], 0, atol=2e-6)
    np.testing.assert_allclose(now["albedo.g"][chosen], 0.6, rtol=1e-6)
    assert edited.mesh is scene.mesh


def test_assignments_are_made_in_order_and_each_sees_the_last(scene: TrainedScene) -> None:
    fields, given = SurfelValues(scene), ["albedo*=1,0.5,0", "roughness*=3", "albedo.r=0.25", "albedo.r*=0.5"]
    now = SurfelValues(edit(scene, set=given)[0])
    np.testing.assert_allclose(now["albedo.r"], 0.125, rtol=1e-6)
    np.testing.assert_allclose(now["albedo.g"], 0.5 * fields["albedo.g"], rtol=1e-5)
    np.testing.assert_allclose(now["roughness"], np.minimum(3 * fields["roughness"], 1), rtol=1e-5)


def test_a_new_colour_scales_all_sh_degrees(scene: TrainedScene) -> None:
    """Radiance only: half the colour is half the image; a new colour keeps the view dependence."""
    plain = replace(balls(reflectance="radiance", occlusion=False), mesh=None)
    doubled = edit(plain, set=["colour*=0.5"])[0]
    np.testing.assert_allclose(image(doubled)[:, :3], 0.5 * image(plain)[:, :3], atol=1e-5)
    before = plain.surfels.to_numpy()["radiance_sh"]
    after = edit(plain, set={"colour": (0.2, 0.3, 0.4)})[0].surfels.to_numpy()["radiance_sh"]
    np.testing.assert_allclose(0.5 + SH_DC * after[:, :3], np.tile((0.2, 0.3, 0.4), (2 * HALF, 1)), rtol=1e-5)
    ratio = (0.2, 0.3, 0.4) / (0.5 + SH_DC * before[:, :3])
    np.testing.assert_allclose(after[:, 3:6], before[:, 3:6] * ratio, rtol=1e-4)
    one = edit(plain, set=["colour.g=0.7"])[0].surfels.to_numpy()["radiance_sh"]
    np.testing.assert_array_equal(one[:, [0, 2, 3, 5]], before[:, [0, 2, 3, 5]])
    # Harmonics that exceed a dark colour do not outshine the new one.
    black = {"radiance_sh": np.concatenate([0 * before[:, :3] - 1.7, 50 * before[:, 3:]], axis=1)}
    dark = replace(plain, surfels=Surfels.from_numpy(plain.surfels.to_numpy() | black))
    same = edit(dark, set=["colour*=1"])[0].surfels.to_numpy()["radiance_sh"]
    np.testing.assert_allclose(same, dark.surfels.to_numpy()["radiance_sh"], atol=1e-5)
    after = edit(dark, set=["colour=0.5"])[0].surfels.to_numpy()["radiance_sh"][:, 3:].reshape(-1, 8, 3)
    assert 0.4 < SH_DC * np.linalg.norm(after, axis=1).max() < 0.501


@pytest.mark.parametrize("change", [{"materials": True}, {"set": {"roughness": 0.3}}])
def test_the_background_stays(change: Any) -> None:
    """Pixels that show only the background are those of before."""
    near = NearField(np.zeros(3), np.full((8, 16), 0.2, np.float32))
    scene = replace(with_background(balls(), 0.3), near=near)
    edited = edit(scene, **change)[0]
    assert edited.near is near
    turned = replace(balls(diffuse="irradiance"), turntable=mi.TensorXf(np.eye(3)))
    assert edit(turned, **change)[0].turntable is turned.turntable
    before, after = image(scene), image(edited)
    alone = [image(replace(x, surroundings=None))[:, 3] for x in (scene, edited)]
    away = alone[0] + alone[1] == 0
    assert np.ptp(before[away, 0]) > 0.2 and 100 < away.sum()
    np.testing.assert_array_equal(after[away], before[away])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"set": ["shininess=1"]}, "'shininess' cannot be set of these surfels; use one of opacity, albedo"),
        ({"set": ["roughness=1.5"]}, "--set: roughness=1.5: out of range; give 0 to 1"),
        ({"set": ["colour=-1"]}, "give 0 or more"),
        ({"set": ["albedo=1,2"]}, "2 values; give 1 or 3"),
        ({"set": ["roughness=0.2 albedo=1"]}, "no assignment"),
        ({"set": ["roughness=x"]}, "no assignment"),
        ({"set": {"roughness": None}}, "no assignment"),
        ({"set": ["roughness=nan"]}, "not finite"),
        ({"where": "shine > 1", "cut": True}, "--where: 'shine' is no value of these surfels; use one of"),
        ({"where": "x > 1 and", "cut": True}, "--where: '': no comparison"),
        ({"where": "x > __import__('os')", "cut": True}, "no comparison"),
        ({"where": 5, "cut": True}, "no comparison"),
        ({"set": [("roughness", 0.3)]}, "no assignment"),
        ({"set": 5}, "no assignment"),
        ({"where": "x > 100", "cut": True}, "none of the 6000 surfels is in it; choose a wider one"),
        ({"cut": True}, "--cut: no surfel would be left"),
        ({"cut": True, "where": "x>0", "set": ["roughness=1"]}, "what is removed cannot be changed"),
        ({"set": None}, "nothing to do"),
        ({"box": (1e30, 0, 0, 1, 1, 1), "cut": True}, "6 finite numbers are needed, none beyond 1e+09"),
        ({"wehre": "x > 0", "set": ["roughness=1"]}, "edit: wehre: unknown option; use some of where, box"),
    ],
)
def test_bad_options_are_refused(scene: TrainedScene, given: dict[str, Any], message: str) -> None:
    assert "\n" not in refused(lambda: edit(scene, **given), message)


def test_cut_removes_a_ball_its_shadow_and_its_reflection() -> None:
    """The rest renders like the other ball without any of the first, mesh included."""
    options: dict[str, Any] = {"ambient_rays": 32, "visibility_rays": 4, "traced_bounces": 1}
    whole = balls(EnvironmentLight.from_radiance(sky(16)), diffuse="irradiance", **options)
    left = edit(whole, where=METAL_BALL, cut=True, invert=True)[0]
    assert left.surfels.count == HALF and left.mesh is not None
    mesh = known_mesh()
    alone = replace(left, mesh=mesh.part(mesh.vertices[mesh.faces].mean(axis=1)[:, 0] < 0))
    assert len(left.mesh.faces) == len(mesh.faces) / 2
    np.testing.assert_allclose(image(left), image(alone), atol=1e-6)
    assert np.abs(image(replace(left, mesh=mesh)) - image(alone)).max() > 0.05


def test_the_background_keeps_its_triangles() -> None:
    """Only the object's triangles are cut."""
    scene = with_background(balls())
    assert scene.mesh is not None
    of_wall = scene.mesh.vertices[scene.mesh.vertices[:, 0] > 0.05]
    for half, _ in (edit(scene, where="z > 0", cut=True, invert=given) for given in (False, True)):
        mesh = half.mesh
        assert mesh is not None and len(mesh.faces) / len(scene.mesh.faces) == pytest.approx(0.75, abs=0.02)
        assert (mesh.vertices[:, 0] > 0.05).sum() == len(of_wall)


def test_transparent_surfels_lose_their_triangles(scene: TrainedScene) -> None:
    assert scene.mesh is not None
    for opacity, kept in ((0.6, 1.0), (0.3, 0.5), (0.0, 0.5)):
        mesh = edit(scene, where=METAL_BALL, set={"opacity": opacity})[0].mesh
        assert mesh is not None and len(mesh.faces) == kept * len(scene.mesh.faces)


def test_notes_name_what_stays_as_fitted(scene: TrainedScene) -> None:
    assert edit(scene, set=["roughness=0.1"])[1]["notes"] == []
    metal = edit(scene, set=["metallic=1"])[1]["notes"]
    assert any("albedo and metallic change what is reflected" in note for note in metal)
    plain = edit(balls(reflectance="radiance", occlusion=False), set=["metallic=1"])[1]["notes"]
    assert any("metallic: no image of this run depends" in note for note in plain)
    assert edit(balls(diffuse="irradiance", occlusion=False), set=["metallic=1"])[1]["notes"] == []


def test_an_edited_run_is_a_run(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An edit of an edit; every command reads it; the run that it came from stays as it was."""
    before = contents(finished)
    new, newer = tmp_path / "new", tmp_path / "newer"
    assert main(["edit", str(finished), "-o", str(new), "--set", "roughness=0.5", "--where", "x > 0"]) == 0
    out = capsys.readouterr().out
    assert main(["edit", str(new), "-o", str(newer), "--set", "metallic=0.25", "--json"]) == 0
    second = json.loads(capsys.readouterr().out)
    assert contents(finished) == before and not (new / "checkpoints").exists()
    record = json.loads((newer / "edit.json").read_text())["edits"]
    assert [edit["selected"] == edit["of"] for edit in record] == [False, True]
    assert record[0]["where"] == "x > 0" and record[0]["set"] == ["roughness=0.5"]
    assert f"{record[0]['selected']} of {record[0]['of']} surfels" in out
    assert second["set"] == ["metallic=0.25"]
    scenes = [TrainedScene.read(folder) for folder in (finished, new, newer)]
    raw = [scene.surfels.to_numpy() for scene in scenes]
    chosen = raw[0]["position"][:, 0] > 0
    assert chosen.sum() == record[0]["selected"]
    np.testing.assert_allclose(raw[1]["roughness"][chosen], logit(0.5), atol=1e-6)
    np.testing.assert_array_equal(raw[1]["roughness"][~chosen], raw[0]["roughness"][~chosen])
    np.testing.assert_array_equal(raw[2]["roughness"], raw[1]["roughness"])
    np.testing.assert_allclose(raw[2]["metallic"], logit(0.25), atol=1e-6)
    for command, *options in (["eval"], ["export"], ["render", "-o", str(tmp_path / "out.png")]):
        assert main([command, str(newer), *options]) == 0


def test_a_reconstruction_is_edited_like_a_run(finished: Path, tmp_path: Path) -> None:
    """Corrections of the fit follow: the exposure of its images and its cameras."""
    corrected = Run(shutil.copytree(finished, tmp_path / "corrected"))
    exposure, cameras = {"gains": "on", "gain": {"test/r_0": [1, 2, 1]}}, {"corrected": True, "to_world": {}}
    corrected.write_json("exposure.json", exposure)
    corrected.write_json("cameras.json", cameras)
    whole = load(corrected.path, write=False)
    both = whole.edit(where="x > 0", set={"albedo": (1, 0, 0)}).edit(where="x < 0", cut=True)
    assert whole.provenance.edits == () and both.folder is None
    first, second = both.provenance.edits
    assert first["of"] == second["of"] == whole.trained.surfels.count
    assert both.trained.surfels.count == second["of"] - second["selected"]
    new = both.save(tmp_path / "new").folder
    assert new is not None
    read = {name: json.loads((new / f"{name}.json").read_text()) for name in ("edit", "exposure", "cameras")}
    edits = json.loads(json.dumps(both.provenance.edits))
    assert read == {"edit": {"edits": edits}, "exposure": exposure, "cameras": cameras}


def test_an_edited_run_is_not_resumed(finished: Path, data: Path, tmp_path: Path) -> None:
    """Training would replace what was edited."""
    new = tmp_path / "new"
    assert main(["edit", str(finished), "-o", str(new), "--set", "roughness=0.5"]) == 0
    before = contents(new)
    refused(["train", data, "-o", new, "--resume"], "checkpoints: none, but a scene that was edited")
    assert contents(new) == before


def test_a_bad_command_writes_nothing(finished: Path, tmp_path: Path) -> None:
    nowhere = ["--set", "roughness=0.5", "--where", "x > 1e9"]
    refused(["edit", finished, "-o", tmp_path / "new", *nowhere], "choose a wider one")
    assert not any(tmp_path.iterdir())
