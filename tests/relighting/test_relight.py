"""Relighting: a known scene under another light agrees with the path tracer; lights, files, scores."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.errors import InputError
from mi_refgs.evaluation.surface import TrueSurface
from mi_refgs.formats import orbits
from mi_refgs.formats.orbits import turntable_cameras
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.images import read_png
from mi_refgs.reconstruction.new_light import NewLight, any_light, truth_under
from mi_refgs.reconstruction.reconstruction import load
from mi_refgs.relighting.relight import relight
from mi_refgs.relighting.score import common_scale, displayed_over, score
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.table import Surfels
from tests.scenes.known import SIZE, other_sky, write_known_data, write_known_run

SAMPLES = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """day.exr, dusk.exr, the data set of two balls under them, and the run that has found everything."""
    mi.set_variant("llvm_ad_rgb")
    folder = tmp_path_factory.mktemp("relight")
    write_known_run(write_known_data(folder), folder / "run")
    return folder


@pytest.fixture(scope="module")
def dusk(folder: Path) -> dict[str, Any]:
    """What relighting by the second light found; its files are in `dusk`."""
    return relight(
        Run(folder / "run"), NewLight(folder / "dusk.exr"), folder / "dusk", samples=SAMPLES
    ).result


# ---------------- against the path tracer ----------------


def test_a_known_scene_agrees_with_the_path_tracer(folder: Path, dusk: dict[str, Any]) -> None:
    """With 40 pixels across two balls: with 128 it is 34 dB."""
    assert dusk["psnr"] > 28 and dusk["psnr_scaled"] > dusk["psnr"] - 0.2 and dusk["score_reason"] is None
    np.testing.assert_allclose(dusk["scale"], 1, atol=0.08)


def test_shadows_and_mirror_images_of_the_other_ball_are_there(folder: Path, dusk: dict[str, Any]) -> None:
    """Mean colour where the balls are close; without rays it is off by up to 1.9 times."""
    surface = TrueSurface.read(folder / "data")
    assert surface is not None
    for i, view in enumerate(read_dataset(folder / "data", "test").views):
        places = (folder / "dusk", folder / "data/relight/dusk")
        ours, truth = (read_exr_image(place / f"test/r_{i:03d}.exr") for place in places)
        concave = surface.concave(view)
        assert concave is not None
        inside = concave & (np.minimum(ours, truth)[..., 3] > 0.99)
        assert inside.sum() > 20
        np.testing.assert_allclose(ours[inside].mean(axis=0), truth[inside].mean(axis=0), rtol=0.1)


def test_the_light_that_it_was_fitted_to_is_not_that_light(folder: Path, dusk: dict[str, Any]) -> None:
    """Pictures under the first light, compared with the second's truth, are far off."""
    light = NewLight(folder / "day.exr")
    own = relight(Run(folder / "run"), light, folder / "own", samples=SAMPLES).result
    assert own["psnr"] is None and "refgs dataset --relight" in own["score_reason"]
    ours = [read_exr_image(folder / "own" / name.replace("png", "exr")) for name in own["pictures"]]
    truth = [read_exr_image(folder / f"data/relight/dusk/test/r_{i:03d}.exr") for i in range(3)]
    found = score("abc", ours, truth, np.ones(3))
    assert found["psnr_scaled"] < dusk["psnr_scaled"] - 3


def test_wrong_albedo_is_what_a_scale_mends_and_wrong_metal_is_not(
    folder: Path, dusk: dict[str, Any]
) -> None:
    """Less albedo is much worse as it is, and nearly as good after the scale."""
    fitted = TrainedScene.read(folder / "run")
    for name, change in (("albedo", 0.7), ("metallic", None)):
        raw = fitted.surfels.to_numpy()
        if change:
            value = 1 / (1 + np.exp(-raw["albedo"])) * change
            raw["albedo"] = np.log(value / (1 - value))
        else:
            raw["metallic"] = -raw["metallic"]
        out = folder / f"wrong_{name}"
        shutil.copytree(folder / "run", out)
        camera = read_dataset(folder / "data", "test").views[0].camera()
        export(replace(fitted, surfels=Surfels.from_numpy(raw)), out, camera)
        light, place = NewLight(folder / "dusk.exr"), folder / f"out_{name}"
        found = relight(Run(out), light, place, samples=SAMPLES).result
        if change:
            assert found["psnr"] < dusk["psnr"] - 2 < found["psnr_scaled"] + 1
            np.testing.assert_allclose(found["scale"], 1 / change, rtol=0.15)
        else:
            assert found["psnr_scaled"] < dusk["psnr_scaled"] - 3


def test_mitsuba_renders_the_scene_file_alike(folder: Path, dusk: dict[str, Any]) -> None:
    image = np.array(mi.render(mi.load_file(str(folder / "dusk" / "scene.xml"), spp=SAMPLES)))
    ours = read_exr_image(folder / "dusk" / "test" / "r_000.exr")
    np.testing.assert_allclose(image, ours, atol=0.02)
    assert np.abs(image - ours).mean() < 1e-4
    assert ours[..., :3].max() > 0.2


def test_files_are_as_a_data_sets(folder: Path, dusk: dict[str, Any]) -> None:
    out = folder / "dusk"
    assert json.loads((out / "relight.json").read_text()) == json.loads(json.dumps(dusk))
    for name in dusk["pictures"]:
        linear, displayed = read_exr_image((out / name).with_suffix(".exr")), read_png(out / name)
        assert linear.shape == displayed.shape == (SIZE, SIZE, 4)
        straight = np.dstack([displayed[..., :3] * displayed[..., 3:] + 1 - displayed[..., 3:]])
        np.testing.assert_allclose(displayed_over(linear, np.ones(3)), straight, atol=1.5 / 255)
    assert read_png(out / "sheet.png").std() > 0.05
    assert not (folder / "run" / "relight").exists()


# ---------------- lights ----------------


def radiance_along(light: EnvironmentLight, direction: Any) -> np.ndarray:
    """Radiance (3, ...) from directions (3, ...)."""
    return np.squeeze(np.array(light.unfiltered().radiance(mi.Vector3f(direction))))


def test_a_panorama_stands_upright_and_turns(tmp_path: Path) -> None:
    """The first row shines from +z; a turn by 90° brings what shone from +x to +y."""
    image = np.full((32, 64, 3), 0.1, np.float32)
    image[:4] = (3, 0, 0)
    image[12:20, 30:34] = (0, 5, 0)
    write_exr(tmp_path / "a.exr", image)
    upright = NewLight(tmp_path / "a.exr").read()
    np.testing.assert_allclose(radiance_along(upright, [0, 0, 1]), (3, 0, 0), atol=0.05)
    np.testing.assert_allclose(radiance_along(upright, [0, 0, -1]), 0.1, atol=0.01)
    as_it_lies = NewLight(tmp_path / "a.exr", world=True).read()
    np.testing.assert_allclose(radiance_along(as_it_lies, [0, 1, 0]), (3, 0, 0), atol=0.05)
    angles = np.radians(np.arange(0, 360, 5))
    horizon = np.stack([np.cos(angles), np.sin(angles), 0 * angles])
    around = radiance_along(upright, horizon)[1]
    assert around.max() > 4
    turned = NewLight(tmp_path / "a.exr", rotate=90).read()
    np.testing.assert_allclose(radiance_along(turned, horizon)[1], np.roll(around, 18), atol=0.7)
    brighter = NewLight(tmp_path / "a.exr", exposure=1.5).read()
    np.testing.assert_allclose(
        np.array(brighter.radiance()), 2**1.5 * np.array(upright.radiance()), rtol=1e-3, atol=3e-4
    )


def test_a_panorama_stands_as_in_the_data_set(folder: Path) -> None:
    """The file that `refgs dataset --relight` was given, and the environment.exr that it made of it."""
    panorama = NewLight(folder / "dusk.exr").read()
    world = NewLight(folder / "data/relight/dusk/environment.exr", world=True).read()
    a, b = (np.array(x.radiance()).reshape(32, 64, 3) for x in (panorama, world))
    np.testing.assert_allclose(a, b, atol=1e-3)


def test_truth_is_found_by_the_content_of_the_light(folder: Path, tmp_path: Path) -> None:
    data = folder / "data"
    shutil.copy(folder / "dusk.exr", tmp_path / "other name.exr")
    found = truth_under(NewLight(tmp_path / "other name.exr", exposure=1), data)
    assert found is not None and found[0] == data / "relight" / "dusk"
    assert found[1] == NewLight(data / "relight/dusk/environment.exr", True, 0, 1)
    own = truth_under(NewLight(data / "environment.exr", world=True), data)
    assert own is not None and own[0] == data
    write_exr(tmp_path / "dusk.exr", 2 * other_sky())
    for light in (
        NewLight(folder / "dusk.exr", rotate=10),
        NewLight(tmp_path / "dusk.exr"),
        NewLight(folder / "dusk.exr", world=True),
    ):
        assert truth_under(light, data) is None
    assert truth_under(NewLight(folder / "dusk.exr"), tmp_path) is None
    with pytest.raises(InputError, match="add --world"):
        truth_under(NewLight(data / "environment.exr"), data)


def test_a_data_set_may_have_the_name_of_a_light(tmp_path: Path) -> None:
    """Its own pictures are not those under that light."""
    data, light = tmp_path / "dusk", tmp_path / "dusk.exr"
    write_exr(light, other_sky())
    for folder in (data, data / "relight" / "dusk"):
        folder.mkdir(parents=True)
        (folder / "environment.exr").write_bytes(b"")
        (folder / "transforms_test.json").write_text("{}")
    digest = hashlib.sha256(light.read_bytes()).hexdigest()
    (data / "dataset.json").write_text(json.dumps({"relight": {"dusk": digest}}))
    found = truth_under(NewLight(light), data)
    assert found is not None and found[0] == data / "relight" / "dusk"


def test_exposure_brightens_ours_and_the_truth(folder: Path, dusk: dict[str, Any]) -> None:
    light = NewLight(folder / "dusk.exr", exposure=-1)
    darker = relight(Run(folder / "run"), light, folder / "dark", samples=SAMPLES).result
    np.testing.assert_allclose(darker["scale"], dusk["scale"], rtol=0.03)
    pictures = [read_exr_image(folder / out / "test/r_001.exr") for out in ("dark", "dusk")]
    np.testing.assert_allclose(2 * pictures[0][..., :3], pictures[1][..., :3], rtol=2e-3, atol=1e-4)


def test_the_scale_is_found_a_channel(rng: np.random.Generator) -> None:
    """Whatever a lamp or an edge does; a black channel has none."""
    true = np.concatenate([rng.uniform(0.05, 0.6, (16, 16, 3)), np.ones((16, 16, 1))], -1)
    true[:2, :2, :3] = 50
    factor = np.array([0.6, 1.3, 2.2])
    ours = true.copy()
    ours[..., :3] /= factor
    ours[3:9, 3:9] *= 0.3  # edges, less covered than they should be
    np.testing.assert_allclose(common_scale([ours, ours], [true, true]), factor, rtol=0.01)
    ours[..., 1] = 0
    np.testing.assert_allclose(common_scale([ours], [true]), factor * [1, 0, 1] + [0, 1, 0], rtol=0.01)


# ---------------- turntable ----------------


def test_a_turntable_goes_around_the_object(folder: Path) -> None:
    relit = relight(Run(folder / "run"), NewLight(folder / "dusk.exr"), folder / "turn", turntable=7).result
    assert len(relit["pictures"]) == 7 and relit["psnr"] is None and "turntable" in relit["score_reason"]
    frames = [read_png(folder / "turn" / name)[..., 3] for name in relit["pictures"]]
    assert all(0.05 < frame.mean() < 0.9 and frame[0].max() == 0 for frame in frames)
    assert not (folder / "turn" / "test").exists() and (folder / "turn" / "scene.xml").is_file()
    fitted, views = TrainedScene.read(folder / "run"), read_dataset(folder / "data", "test").views
    around = turntable_cameras(fitted, [view.camera() for view in views], 4)
    assert around[0].width == SIZE and around[0].focal == pytest.approx(views[0].fx)
    poses = np.array([camera.pose() for camera in around])
    middle = poses[:, :3, 3].mean(axis=0)
    offset = poses[:, :3, 3] - middle
    assert np.ptp(offset[:, 2]) < 1e-9 and np.ptp(np.linalg.norm(offset, axis=1)) < 1e-9
    np.testing.assert_allclose(offset[0, :2], -offset[2, :2], atol=1e-9)
    assert (poses[:, 2, 1] > 0).all()  # upright


# ---------------- without a data set ----------------


@pytest.mark.parametrize("record", [None, '{"path": "gone"}'])
@pytest.mark.parametrize("turntable", [0, 2])
def test_a_run_without_data_is_relit_around_the_object(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
    record: str | None,
    turntable: int,
) -> None:
    """A saved run that records no data set, and one whose data is gone; alike from Python."""
    monkeypatch.setattr(orbits, "SIZE", SIZE)
    run = load(folder / "run").save(tmp_path / "run").folder
    assert run is not None
    (run / "dataset.json").unlink()
    if record is not None:
        (run / "dataset.json").write_text(record)
    light, out = folder / "dusk.exr", tmp_path / "out"
    command = ["relight", str(run), "--envmap", str(light), "-o", str(out), "--json"]
    assert main([*command, "--turntable", str(turntable)]) == 0
    result = json.loads(capfd.readouterr().out)
    assert "cameras are around the object" in result["score_reason"] and result["psnr"] is None
    relit = load(run).relight(light)
    cameras = relit.turntable(turntable) if turntable else relit.cameras()
    assert len(result["pictures"]) == len(cameras) and (out / "sheet.png").is_file()
    for name, camera in zip(result["pictures"], cameras, strict=True):
        shown = read_exr_image((out / name).with_suffix(".exr"))
        np.testing.assert_allclose(shown, relit.render(camera), atol=1e-4)
        assert 0.05 < shown[..., 3].mean() < 0.9
    if record is not None and not turntable:  # with its data named it has the truth
        found = relight(Run(run), NewLight(light), tmp_path / "named", data=folder / "data").result
        assert found["psnr"] > 20


# ---------------- the command, and what it refuses ----------------


def test_the_command(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    command = [
        "relight",
        str(folder / "run"),
        "--envmap",
        str(folder / "dusk.exr"),
        "-o",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["psnr_scaled"] > 20
    assert main([*command, "--azimuth", "30"]) == 2
    assert "r_000.png: output: exists, and was not written" in capfd.readouterr().err
    assert main([*command[:-1], str(tmp_path / "turned"), "--azimuth", "30"]) == 0
    shown = capfd.readouterr()
    assert "score: none" in shown.out and "warning" not in shown.err


def test_a_fitted_colour_is_warned_of(folder: Path, tmp_path: Path) -> None:
    run = write_known_run(folder / "data", tmp_path / "run", diffuse="sh")
    relit = relight(run, NewLight(folder / "dusk.exr"), turntable=2)
    assert "--for relighting" in relit.warning and (tmp_path / "run/relight/dusk/sheet.png").is_file()
    turned = relight(run, NewLight(folder / "dusk.exr", rotate=90, exposure=-1), turntable=1).result
    assert Path(turned["output"]) == tmp_path / "run/relight/dusk_r90_e-1"
    # Fewer frames leave none of the old ones behind.
    relight(run, NewLight(folder / "dusk.exr"), turntable=1)
    frames = (tmp_path / "run/relight/dusk/turntable").glob("*.png")
    assert [frame.name for frame in frames] == ["t_000.png"]


def test_what_cannot_be_relit(folder: Path, tmp_path: Path) -> None:
    run, light = Run(folder / "run"), NewLight(folder / "dusk.exr")
    (tmp_path / "bad.exr").write_text("no picture")
    with pytest.raises(InputError, match="contains a run"):
        relight(run, light, folder / "run")
    with pytest.raises(InputError, match="a data set"):
        relight(run, light, folder / "data")
    with pytest.raises(InputError, match="--turntable: -1"):
        relight(run, light, turntable=-1)
    with pytest.raises(InputError, match=r"bad\.exr"):
        relight(run, NewLight(tmp_path / "bad.exr"), tmp_path / "out")
    with pytest.raises(InputError, match=r"none\.exr"):
        NewLight(tmp_path / "none.exr")
    for rotate, exposure in ((float("nan"), 0.0), (0.0, 50.0)):
        with pytest.raises(InputError, match="--rotate, --exposure"):
            NewLight(folder / "dusk.exr", False, rotate, exposure)
        for given in (other_sky(), NewLight(folder / "dusk.exr").read()):
            with pytest.raises(InputError, match=r"light: rotate, exposure: .* out of range"):
                any_light(given, False, rotate, exposure)
    bare = Run(Path(shutil.copytree(run.path, tmp_path / "bare")))
    fitted = TrainedScene.read(run.path)
    camera = read_dataset(folder / "data", "test").views[0].camera()
    export(replace(fitted, light=None, mesh=None, shading=Shading("surfel", "radiance")), bare.path, camera)
    with pytest.raises(InputError, match=r"bare: light: the run has none; fit one .*--for relighting"):
        relight(bare, light, tmp_path / "out")
