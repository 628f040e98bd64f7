"""Relighting: a known scene under another light against path tracing; lights, files, scores, refusals."""

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
from mi_refgs.evaluation.images import displayed_over
from mi_refgs.evaluation.surface import TrueSurface
from mi_refgs.formats import orbits
from mi_refgs.formats.orbits import turntable_cameras
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.images import read_png
from mi_refgs.reconstruction.new_light import NewLight
from mi_refgs.reconstruction.reconstruction import load
from mi_refgs.reconstruction.relight import common_scale, relight
from mi_refgs.runs.export import export
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.shading import Shading
from tests.helpers import refused
from tests.scenes.known import SIZE, write_known_run

SAMPLES = 4


def result_of(known: Path, out: str, **options: Any) -> dict[str, Any]:
    """The result of relighting the known run by the second light, into the folder `out`."""
    return relight(Run(known / "run"), NewLight(known / "dusk.exr", **options), known / out, samples=SAMPLES)


@pytest.fixture(scope="module")
def dusk(known: Path) -> dict[str, Any]:
    """The result of relighting by the second light; its files are in `dusk`."""
    return result_of(known, "dusk")


def test_relit_scene_matches_path_tracing(known: Path, dusk: dict[str, Any]) -> None:
    """At 40 pixels across two balls; at 128 the PSNR is 34 dB."""
    assert dusk["psnr"] > 28 and dusk["psnr_scaled"] > dusk["psnr"] - 0.2 and dusk["score_reason"] is None
    np.testing.assert_allclose(dusk["scale"], 1, atol=0.08)


def test_relit_scene_has_shadows_and_reflections(known: Path, dusk: dict[str, Any]) -> None:
    """Mean colour where the balls are close; without rays it is wrong by a factor of up to 1.9."""
    surface = TrueSurface.read(known / "data")
    assert surface is not None
    for i, view in enumerate(read_dataset(known / "data", "test").views):
        places = (known / "dusk", known / "data/relight/dusk")
        ours, truth = (read_exr_image(place / f"test/r_{i:03d}.exr") for place in places)
        concave = surface.concave(view)
        assert concave is not None
        inside = concave & (np.minimum(ours, truth)[..., 3] > 0.99)
        assert inside.sum() > 20
        np.testing.assert_allclose(ours[inside].mean(axis=0), truth[inside].mean(axis=0), rtol=0.1)


def test_mitsuba_renders_the_relit_scene_file_the_same(known: Path, dusk: dict[str, Any]) -> None:
    image = np.array(mi.render(mi.load_file(str(known / "dusk" / "scene.xml"), spp=SAMPLES)))
    ours = read_exr_image(known / "dusk" / "test" / "r_000.exr")
    np.testing.assert_allclose(image, ours, atol=0.02)
    assert np.abs(image - ours).mean() < 1e-4 and ours[..., :3].max() > 0.2


def test_relit_files_have_the_encoding_of_a_data_set(known: Path, dusk: dict[str, Any]) -> None:
    out = known / "dusk"
    assert Path(dusk["light"]) == known / "dusk.exr"
    assert json.loads((out / "relight.json").read_text()) == json.loads(json.dumps(dusk))
    for name in dusk["images"]:
        linear, displayed = read_exr_image((out / name).with_suffix(".exr")), read_png(out / name)
        assert linear.shape == displayed.shape == (SIZE, SIZE, 4)
        straight = displayed[..., :3] * displayed[..., 3:] + 1 - displayed[..., 3:]
        np.testing.assert_allclose(displayed_over(linear, np.ones(3)), straight, atol=1.5 / 255)
    assert read_png(out / "sheet.png").std() > 0.05
    assert not (known / "run" / "relight").exists()


def test_exposure_scales_ours_and_ground_truth(known: Path, dusk: dict[str, Any]) -> None:
    np.testing.assert_allclose(result_of(known, "dark", exposure=-1)["scale"], dusk["scale"], rtol=0.03)
    pictures = [read_exr_image(known / out / "test/r_001.exr") for out in ("dark", "dusk")]
    np.testing.assert_allclose(2 * pictures[0][..., :3], pictures[1][..., :3], rtol=2e-3, atol=1e-4)


def test_common_scale_is_fitted_per_channel(rng: np.random.Generator) -> None:
    """Lamps and edges do not affect it; a black channel has scale 1, of a translucent object, too."""
    true = np.concatenate([rng.uniform(0.05, 0.6, (16, 16, 3)), np.ones((16, 16, 1))], -1)
    true[:2, :2, :3] = 50
    factor = np.array([0.6, 1.3, 2.2])
    ours = true / [*factor, 1]
    ours[3:9, 3:9] *= 0.3  # edges, less covered than they should be
    np.testing.assert_allclose(common_scale([ours, ours], [true, true]), factor, rtol=0.01)
    ours[..., 1] = 0
    for alpha in (1, 0.8):
        np.testing.assert_allclose(common_scale([alpha * ours], [alpha * true]), [0.6, 1, 2.2], rtol=0.01)


def test_turntable_surrounds_the_object(known: Path) -> None:
    relit = relight(Run(known / "run"), NewLight(known / "dusk.exr"), known / "turn", turntable=3)
    assert len(relit["images"]) == 3 and relit["psnr"] is None and "turntable" in relit["score_reason"]
    frames = [read_png(known / "turn" / name)[..., 3] for name in relit["images"]]
    assert all(0.05 < frame.mean() < 0.9 and frame[0].max() == 0 for frame in frames)
    assert not (known / "turn" / "test").exists() and (known / "turn" / "scene.xml").is_file()
    fitted, views = TrainedScene.read(known / "run"), read_dataset(known / "data", "test").views
    around = turntable_cameras(fitted, [view.camera() for view in views], 4)
    assert around[0].width == SIZE and around[0].focal == pytest.approx(views[0].fx)
    poses = np.array([camera.pose() for camera in around])
    offset = poses[:, :3, 3] - poses[:, :3, 3].mean(axis=0)
    assert np.ptp(offset[:, 2]) < 1e-9 and np.ptp(np.linalg.norm(offset, axis=1)) < 1e-9
    np.testing.assert_allclose(offset[0, :2], -offset[2, :2], atol=1e-9)
    assert (poses[:, 2, 1] > 0).all()  # upright


@pytest.mark.parametrize(("record", "turntable"), [(None, 2), ('{"path": "gone"}', 0)])
def test_run_without_data_is_relit_around_the_object(
    known: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, record: str | None, turntable: int
) -> None:
    """A saved run that records no data set, and one whose data is gone; the same in Python."""
    monkeypatch.setattr(orbits, "SIZE", SIZE)
    run = tmp_path / "run"
    load(known / "run").save(run)
    (run / "dataset.json").unlink()
    if record is not None:
        (run / "dataset.json").write_text(record)
    light, out = known / "dusk.exr", tmp_path / "out"
    command = ["relight", str(run), "--envmap", str(light), "-o", str(out)]
    assert main([*command, "--turntable", str(turntable)]) == 0
    folder = out / "turntable" if turntable else out
    result = json.loads((folder / "relight.json").read_text())
    assert "cameras are around the object" in result["score_reason"] and result["psnr"] is None
    relit = load(run).relight(light)
    cameras = relit.turntable(turntable) if turntable else relit.cameras()
    assert len(result["images"]) == len(cameras) and (folder / "sheet.png").is_file()
    for name, camera in zip(result["images"], cameras, strict=True):
        shown = read_exr_image((out / name).with_suffix(".exr"))
        np.testing.assert_allclose(shown, relit.render(camera), atol=1e-4)
        assert 0.05 < shown[..., 3].mean() < 0.9
    if record is not None and not turntable:  # with its data named there is ground truth
        assert relight(Run(run), NewLight(light), tmp_path / "named", data=known / "data")["psnr"] > 20


def test_relight_command(known: Path, tmp_path: Path, capfd: pytest.CaptureFixture) -> None:
    light, out = known / "dusk.exr", tmp_path / "out"
    command = ["relight", str(known / "run"), "--envmap", str(light), "-o", str(out)]
    assert main([*command, "--json"]) == 0
    plain = json.loads(capfd.readouterr().out)
    assert plain["psnr_scaled"] > 20
    assert json.loads((out / "relight.json").read_text()) == plain
    refused([*command, "--azimuth", "30"], "output: has other files")
    refused(["export", str(out)], "config.toml: missing; it is a relit scene: give its run")
    assert main([*command[:-1], str(tmp_path / "turned"), "--azimuth", "30"]) == 0
    shown = capfd.readouterr()
    assert "score: none" in shown.out and "warning" not in shown.err


def test_images_without_linear_radiance_are_no_ground_truth(known: Path, tmp_path: Path) -> None:
    data = shutil.copytree(known / "data", tmp_path / "data")
    for path in data.glob("test/r_???.exr"):
        path.unlink()
    relit = relight(Run(known / "run"), NewLight(data / "environment.exr", True), tmp_path / "out", data=data)
    assert relit["psnr"] is None and "r_000.png: images: no EXR file" in relit["score_reason"]


def test_relight_warns_of_fitted_diffuse_colour(known: Path, tmp_path: Path) -> None:
    run = write_known_run(known / "data", tmp_path / "run", diffuse="sh")
    relit = relight(run, NewLight(known / "dusk.exr"), turntable=2)
    folder = tmp_path / "run/relight/dusk"
    assert "--for relighting" in relit["warning"] and (folder / "turntable/sheet.png").is_file()
    assert not (folder / "sheet.png").exists()  # nor are the scores of test views replaced
    turned = relight(run, NewLight(known / "dusk.exr", rotate=90, exposure=-1), turntable=1)
    assert Path(turned["output"]) == tmp_path / "run/relight/dusk_r90_e-1"
    # Bad input leaves them; fewer frames leave none of the old ones behind.
    refused(lambda: relight(run, NewLight(known / "dusk.exr"), turntable=1, samples=0), "samples")
    assert (folder / "turntable/t_001.png").is_file()
    relight(run, NewLight(known / "dusk.exr"), turntable=1)
    assert [frame.name for frame in (folder / "turntable").glob("t_*.png")] == ["t_000.png"]


def test_relight_refuses_bad_input(known: Path, tmp_path: Path) -> None:
    run, light = Run(known / "run"), NewLight(known / "dusk.exr")
    refused(lambda: relight(run, light, known / "run"), "belongs to a run")
    refused(lambda: relight(run, light, known / "data"), "has other files")
    refused(lambda: relight(run, light, turntable=-1), "turntable: -1 is out of range")
    turned = NewLight(known / "data" / "environment.exr")
    refused(lambda: relight(run, turned, tmp_path / "out", turntable=1), "world directions", "add --world")
    refused(lambda: NewLight(light.path, rotate=float("nan")), "light: rotation: nan is no angle")
    bare = Run(shutil.copytree(run.path, tmp_path / "bare"))
    changes: dict[str, Any] = {"light": None, "mesh": None, "shading": Shading("surfel", "radiance")}
    colour = replace(TrainedScene.read(run.path), **changes)
    export(colour, bare.path, read_dataset(known / "data", "test").views[0].camera())
    words = "bare: reflectance: radiance shows the light of the fit only; fit one", "--for relighting"
    refused(lambda: relight(bare, light, tmp_path / "out"), *words)
