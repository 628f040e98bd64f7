"""`mi_refgs.load`, `fit` and `Reconstruction`: images, Mitsuba scenes, changes, run folders, refusals."""

import gc
import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

import mi_refgs
from mi_refgs import Camera, InputError, NewLight, Reconstruction
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.region import Region
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.exr import read_exr_image
from mi_refgs.methods.read import load_resolved
from mi_refgs.render.surroundings import Surroundings, nothing_around
from mi_refgs.runs.run import CAMERAS, Run
from mi_refgs.runs.views import digests
from mi_refgs.shade.shading import Shading
from tests.helpers import refused
from tests.scenes.integrator import sky
from tests.scenes.known import SIZE, with_background
from tests.scenes.tiny import SETTINGS


def psnr(ours: np.ndarray, truth: np.ndarray) -> float:
    """PSNR of linear premultiplied images in dB."""
    return float(-10 * np.log10(np.mean((ours - truth) ** 2)))


def test_render_matches_path_tracing(known: Path, balls: Reconstruction) -> None:
    """Position, orientation, premultiplication and encoding are right in the first test view."""
    truth = read_exr_image(known / "data/test/r_000.exr")
    ours = balls.render(0, samples=4)
    assert ours.shape == (SIZE, SIZE, 4) and ours.dtype == np.float32
    assert psnr(ours, truth) > 23 > psnr(ours[:, ::-1], truth) + 5


def test_render_accepts_every_kind_of_camera(balls: Reconstruction) -> None:
    """An index, a view and a camera agree; so do a Mitsuba sensor and `look_at` of the same numbers."""
    first = balls.render()
    np.testing.assert_array_equal(balls.render(balls.views().views[0]), first)
    np.testing.assert_array_equal(balls.render(balls.cameras()[0]), first)
    assert not np.array_equal(balls.render(-1), first)
    eye, middle, up = [2.0, 2.5, 1.0], [0.1, 0.0, 0.2], [0.0, 0.3, 1.0]
    film, pose = {"type": "hdrfilm", "width": 48, "height": 32}, mi.ScalarTransform4f()
    pose = pose.look_at(eye, middle, up)
    sensor = mi.load_dict({"type": "perspective", "fov": 35, "to_world": pose, "film": film})
    camera = Camera.look_at(eye, middle, up, fov=35, size=(48, 32))
    np.testing.assert_allclose(balls.render(sensor), balls.render(camera), atol=2e-3)


def test_render_size_keeps_the_view(balls: Reconstruction) -> None:
    """Twice the size, averaged, equals 2 × 2 samples; one number is the longer side."""
    mean = balls.render(0, size=2 * SIZE).reshape(SIZE, 2, SIZE, 2, 4).mean(axis=(1, 3))
    np.testing.assert_allclose(mean, balls.render(0, samples=4), atol=1e-5)
    camera = Camera.look_at([3, 0, 1], size=(64, 32))
    longest: Any = np.int64(20)
    assert balls.render(camera, size=longest).shape == (10, 20, 4)
    assert balls.render(camera, size=(9, 7)).shape == (7, 9, 4)


def test_aovs_are_the_known_materials(balls: Reconstruction) -> None:
    maps = balls.aovs(0, ["albedo", "roughness", "metallic", "normal", "depth", "diffuse", "specular"])
    inside = balls.render(0)[..., 3] > 0.99
    assert maps["albedo"].shape == (SIZE, SIZE, 3) and maps["depth"].shape == (SIZE, SIZE, 1)
    metal, clay = (inside & one[..., 0] for one in (maps["metallic"] > 0.9, maps["metallic"] < 0.1))
    assert min(metal.sum(), clay.sum()) > 100
    np.testing.assert_allclose(np.median(maps["albedo"][metal], axis=0), [0.9, 0.6, 0.3], atol=0.01)
    np.testing.assert_allclose(np.median(maps["roughness"][clay]), 0.5, atol=0.01)
    np.testing.assert_allclose(np.linalg.norm(maps["normal"][inside], axis=-1), 1, atol=1e-5)
    summed = maps["diffuse"] + maps["specular"] + balls.aovs(0, ["indirect"])["indirect"]
    np.testing.assert_allclose(summed, balls.render(0)[..., :3], atol=1e-5)


def test_background_makes_the_image_opaque(known: Path, balls: Reconstruction) -> None:
    """The background is visible behind the object, and `object_only` leaves it out."""
    behind = mi_refgs.EnvironmentLight.constant(0.25, height=8)
    around = Surroundings(nothing_around(balls.trained.surfels), behind)
    open_scene = balls.changed(replace(balls.trained, surroundings=around))
    whole, alone = open_scene.render(0), open_scene.render(0, object_only=True)
    np.testing.assert_allclose(alone, balls.render(0), atol=1e-6)
    np.testing.assert_allclose(whole[..., :3], alone[..., :3] + 0.25 * (1 - alone[..., 3:]), atol=1e-5)
    assert (whole[..., 3] == 1).all()


def test_cameras_without_data_set_surround_the_object(balls: Reconstruction, tmp_path: Path) -> None:
    """The whole object is visible; a turntable has one height."""
    shutil.copytree(balls.folder or Path(), tmp_path / "run")
    Run(tmp_path / "run").write_dataset(str(tmp_path / "gone"), None)
    lost = mi_refgs.load(tmp_path / "run")
    for camera in (*lost.cameras()[:2], *lost.turntable(2)):
        picture = lost.render(camera, size=24)
        assert picture[8:16, 8:16, 3].mean() > 0.5 and picture[[0, -1], :, 3].max() < 0.01
    spread = np.ptp([camera.pose()[:3, 3] for camera in lost.turntable(4)], axis=0)
    assert spread[2] < 1e-6 and spread[0] > 1
    refused(lost.views, "gone is gone; use cameras")
    (tmp_path / "gone").mkdir()  # there again, but empty
    with pytest.warns(RuntimeWarning, match="views are left out: .*no layout"):
        lost.edit(set=["roughness=0.5"]).save(tmp_path / "edited")
    assert Camera.from_sensor(mi.load_file(str(tmp_path / "edited" / "scene.xml")).sensors()[0]).width == 512


def test_a_saved_mesh_occludes_what_is_relit(balls: Reconstruction, tmp_path: Path) -> None:
    """Also of a run whose own shading traces nothing."""
    shading = Shading("pixel", "split_sum").untraced()
    plain = balls.changed(replace(balls.trained, shading=shading))
    loaded = mi_refgs.load(plain.save(tmp_path / "run").folder or Path())
    assert loaded.trained.mesh is not None
    relit = [one.relight(sky()) for one in (plain, loaded)]
    assert all(one.trained.shading.occlusion for one in relit)
    np.testing.assert_allclose(relit[1].render(0), relit[0].render(0), atol=1e-4)


def test_training_cameras_are_those_that_the_fit_corrected(balls: Reconstruction, tmp_path: Path) -> None:
    """Cameras, views and exported cameras, also of a saved copy; test cameras stay."""
    run = Run(shutil.copytree(balls.folder or Path(), tmp_path / "run"))
    names = [view.name for view in balls.views("train").views]
    poses = [camera.pose() for camera in balls.cameras("train")]
    poses[1][:3, 3] += [0.25, 0, 0]
    record = dict(zip(names, [pose.tolist() for pose in poses], strict=True))
    run.write_json(CAMERAS, {"corrected": True, "to_world": record})
    corrected = mi_refgs.load(run.path).save(tmp_path / "copy")
    np.testing.assert_array_equal([view.to_world for view in corrected.views("train").views], poses)
    np.testing.assert_allclose([camera.pose() for camera in corrected.cameras("train")], poses, atol=1e-6)
    np.testing.assert_array_equal(corrected.cameras()[1].pose(), balls.cameras()[1].pose())
    frames: list[Any] = []
    for made in (balls, corrected):
        files = made.export("cameras", tmp_path / str(len(frames)))
        frames.append(json.loads(files[0].read_text())["frames"])
    assert [new["file_path"] for old, new in zip(*frames, strict=True) if old != new] == ["train/r_001.png"]


def test_turntable_of_an_open_scene_is_around_its_region(balls: Reconstruction) -> None:
    source = replace(balls.provenance, region=Region((0.0, 0.0, 0.0), 1.0))
    whole = replace(balls.changed(with_background(balls.trained)), provenance=source)
    centre = np.mean([camera.pose()[:2, 3] for camera in whole.turntable(4)], axis=0)
    np.testing.assert_allclose(centre, 0, atol=0.05)


def test_mitsuba_scene_renders_the_same(balls: Reconstruction) -> None:
    """Each sensor equals its camera; `tests.gradients` has its derivatives."""
    scene = balls.scene([0, 1], aovs=["normal"])
    for i in range(2):
        image = mi.render(scene, sensor=i, spp=1).numpy()
        difference = np.abs(image[..., :4] - balls.render(i))
        assert image.shape == (SIZE, SIZE, 7) and np.median(difference) < 1e-5 and difference.mean() < 1e-3


def test_mitsuba_scene_keeps_the_crop_of_a_sensor(balls: Reconstruction) -> None:
    """Its place on the film, on which the random numbers of a pixel depend, too."""
    film = {"type": "hdrfilm", "width": 48, "height": 32, "crop_offset_x": 10, "crop_offset_y": 4}
    film |= {"crop_width": 24, "crop_height": 20}
    pose = mi.ScalarTransform4f().look_at([2.0, 2.5, 1.0], [0.1, 0.0, 0.2], [0.0, 0.0, 1.0])
    sensor = mi.load_dict({"type": "perspective", "fov": 35, "to_world": pose, "film": film})
    scene = balls.scene(sensor)
    camera = Camera.from_sensor(scene.sensors()[0])
    assert (camera.offset, camera.film, camera.width, camera.height) == ((10, 4), (48, 32), 24, 20)
    np.testing.assert_allclose(mi.render(scene, spp=1).numpy(), balls.render(sensor), atol=2e-3)
    with pytest.warns(RuntimeWarning, match="fx and fy differ"):
        balls.scene(replace(camera, fy=camera.fy * 1.001))


def test_saved_run_renders_bit_identically(balls: Reconstruction, tmp_path: Path) -> None:
    """A run, and a reconstruction that was changed in memory."""
    known = replace(balls.provenance, images=digests(balls.provenance.views("train")))
    saved = replace(balls, provenance=known).save(tmp_path / "new")
    assert saved.folder == tmp_path / "new" and not (tmp_path / "new/checkpoints").exists()
    again = mi_refgs.load(tmp_path / "new")
    relit = again.relight(sky(32), rotate=30)
    for before, after in ((balls, saved), (balls, again), (relit, relit.save(tmp_path / "relit"))):
        np.testing.assert_array_equal(before.render(1), after.render(1))
    assert again.provenance == known


def test_relight_accepts_every_kind_of_light(known: Path, balls: Reconstruction) -> None:
    """The image matches path tracing under that light, of which the data set has views."""
    file = known / "dusk.exr"
    light = mi_refgs.EnvironmentLight.from_file(known / "data/relight/dusk/environment.exr")
    relit = balls.relight(file)
    truth = read_exr_image(known / "data/relight/dusk/test/r_001.exr")
    assert psnr(relit.render(1, samples=4), truth) > 25 > psnr(balls.render(1, samples=4), truth)
    assert relit.folder is None and relit.trained.light is not None
    for given in (read_exr_image(file)[..., :3], light, NewLight(file)):
        found = balls.relight(given).trained.light
        assert found is not None
        np.testing.assert_allclose(found.radiance(), relit.trained.light.radiance(), atol=2e-3)


def test_fit_equals_the_command(data: Path, method: Path, finished: Path, tmp_path: Path) -> None:
    """The folder is the same, with previews; settings as a mapping equal `--set`."""
    settings, run = {key: int(n) for key, n in (text.split("=") for text in SETTINGS)}, tmp_path / "run"
    with pytest.warns(UserWarning, match="only 3 training views|share nearly nothing"):
        found = mi_refgs.fit(data, method, preset="quick", settings=settings, output=run, progress=False)
    assert load_resolved(run / "config.toml") == load_resolved(finished / "config.toml")
    names, theirs = ({p.relative_to(f) for p in f.rglob("*") if p.is_file()} for f in (run, finished))
    assert names == theirs and found.trained.iteration == 6 and found.folder == run
    np.testing.assert_array_equal(found.render(), mi_refgs.load(run).render())


def test_temporary_folder_is_removed_with_its_last_user(data: Path, method: Path) -> None:
    class Heard(mi_refgs.Progress):
        steps, said = 0, ""

        def say(self, message: str) -> None:
            self.said += message

        def step(self, trainer: Trainer) -> None:
            self.steps += 1

    views = read_dataset(data, "train", downscale=1.5, background="black").relative_to([1, 0, 0])
    heard = Heard()
    for setting, has in (("downscale=2", "1.5"), ("background='white'", "black"), ("images='exr'", "png")):
        with pytest.raises(InputError, match=f"data.*: the views were read with {has}; drop it"):
            mi_refgs.fit(views, method, preset="quick", settings=[*SETTINGS, f"data.{setting}"])
    found = mi_refgs.fit(views, method, preset="quick", settings=SETTINGS, progress=heard)
    folder, read = found.folder, found.views()
    assert folder is not None and str(folder) in heard.said and heard.steps == 6
    assert read.views[0].width == views.views[0].width and not read.background.any()
    sensor = mi.load_file(str(folder / "scene.xml")).sensors()[0]  # relative to the fit's own origin
    origin = np.ravel(sensor.world_transform().translation())
    np.testing.assert_allclose(origin, read.views[0].to_world[:3, 3], atol=1e-6)
    kept = found.changed(found.trained)
    del found, heard
    gc.collect()
    assert (folder / "surfels.ply").is_file()
    del kept
    gc.collect()
    assert not folder.exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.render(99), "camera: 99: test has 3; give 0 to 2"),
        (lambda r: r.render("front"), "camera: str: no camera; give a Camera"),
        (lambda r: r.render(size=0), "size: .* pixels; give whole numbers from 1"),
        (lambda r: r.aovs(0, ["colour"]), "aovs: colour: unknown; use some of .*albedo"),
        (lambda r: r.aovs(0, ["tint"]), "aovs: tint: the surfels have no such attribute"),
        (lambda r: r.scene(aovs=["colour"]), "unknown type 'colour'"),
        (lambda r: r.turntable(0), "turntable: 0 is out of range"),
        (lambda r: r.relight("none.exr"), "none.exr: file: missing"),
        (lambda r: r.relight(np.ones((4, 8))), "is no lat-long map; give linear radiance"),
        (lambda r: r.relight(NewLight(Path(__file__)), rotate=30), "light: NewLight: it has its own world, "),
        (lambda r: r.changed(r.trained).evaluate(), "only in memory; measure what save"),
        (lambda r: Camera.look_at([0, 0, 1], up=[0, 0, 1]), "up: no direction besides that of the view"),
        (lambda r: Camera.look_at([1, 0, 0], fov=180), "fov, size: 180 degrees"),
        (lambda r: mi_refgs.load("nowhere"), "nowhere: config.toml: missing"),
        (lambda r: mi_refgs.fit("x", resume=True), "resume: there is no run .* give its folder as `output`"),
        (lambda r: mi_refgs.fit("x", r.method, preset="quick"), "a Method has its own; change it, or name"),
        (lambda r: mi_refgs.fit("x", settings={"a": None}), "settings: .*; give numbers"),
        (lambda r: mi_refgs.fit(replace(v := r.views("train"), views=v.views * 2)), "2 views have this name"),
        (lambda r: mi_refgs.fit(replace(r.views("train"), views=())), "it has 0 train views; give train"),
    ],
)
def test_reconstruction_refuses_bad_input(balls: Reconstruction, call: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as info:
        call(balls)
    assert "\n" not in str(info.value)


def test_load_requires_a_supported_variant(balls: Reconstruction) -> None:
    mi.set_variant("scalar_rgb")
    with pytest.raises(InputError, match=r"mi_refgs.load: variant: .* call mi.set_variant\('llvm_ad_rgb'\)"):
        mi_refgs.load(balls.folder or "")
