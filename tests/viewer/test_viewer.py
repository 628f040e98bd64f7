"""`refgs view` without a browser: sizes and times of pictures, cameras, the loop, the scene that it shows."""

from __future__ import annotations

import itertools
import math
import socket
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.editing import Change, Selection, apply, assignments, select
from mi_refgs.errors import InputError
from mi_refgs.evaluation.images import image_array
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.exr import read_exr_image
from mi_refgs.methods.read import load
from mi_refgs.render import passes
from mi_refgs.render.load_scene import load_scene
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.export import export
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels
from mi_refgs.viewer import resolution
from mi_refgs.viewer.comparison import BORDER, GAP, side_by_side
from mi_refgs.viewer.loop import Client, DeliveredImage, RenderLoop
from mi_refgs.viewer.mitsuba_scene import MitsubaScene
from mi_refgs.viewer.panels import light_of
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import ReconstructionView
from mi_refgs.viewer.resolution import COARSE, DONE, LARGE, NOTHING
from mi_refgs.viewer.saving import write_view
from mi_refgs.viewer.tonemap import DisplayOptions, displayed_planes, to_bytes
from mi_refgs.viewer.training import Training, TrainingPage, read_log
from mi_refgs.viewer.viewer_scene import SampleRequest, SampleResult, ViewerScene
from tests.helpers import ROOT
from tests.scenes.known import known_scene
from tests.scenes.tiny import SETTINGS


@pytest.fixture(scope="module")
def scene() -> TrainedScene:
    """A ball of metal and one of glaze, whose every material is known."""
    mi.set_variant("llvm_ad_rgb")
    return known_scene()


@pytest.mark.parametrize("name", ["../light.exr", f"light.{'x' * 300}", "light.\0"])
def test_the_name_of_an_uploaded_light_is_nothing_but_a_name(name: str) -> None:
    """What kind it is, its first bytes say; names come from a browser, and any exception but one ends it."""
    content = (ROOT / "scenes" / "lights" / "sky.exr").read_bytes()
    assert light_of(name, content, world=False).height == 128
    with pytest.raises(InputError, match="not a readable image"):
        light_of(name, b"nothing", world=False)


# ---------------- how large, and when ----------------


def test_sizes_are_few_and_of_the_area_that_they_are_named_for() -> None:
    assert resolution.size_of(800, 1.0) == (800, 800)
    for side, shape in itertools.product(resolution.SIDES, resolution.SHAPES):
        width, height = resolution.size_of(side, shape)
        assert width % resolution.MULTIPLE == height % resolution.MULTIPLE == 0
        assert width * height == pytest.approx(side * side, rel=0.04)
        assert width / height == pytest.approx(shape, rel=0.04)


def test_a_window_gets_the_nearest_shape_and_the_nearest_area() -> None:
    assert [resolution.shape_of(*w) for w in ((1280, 800), (1920, 1000), (800, 800), (400, 900))] == [
        1.6,
        1.6,
        1.0,
        0.625,
    ]
    assert resolution.still_side(800, 800) == 800
    assert resolution.still_side(300, 200) == 283
    assert resolution.still_side(3840, 2160) == resolution.FINEST
    assert resolution.still_side(3840, 2160, 400) == 400


def test_moving_pictures_get_as_large_as_there_is_time_for() -> None:
    assert resolution.moving_side(283, 0.1, 1131) == 200
    assert resolution.moving_side(283, 0.03, 1131) == 283
    assert resolution.moving_side(283, 0.005, 1131) == 400
    assert resolution.moving_side(resolution.COARSEST, 9.0, 1131) == resolution.COARSEST
    assert resolution.moving_side(566, 0.001, 566) == 566


def test_pictures_are_due_at_once_then_when_it_is_still_then_until_they_are_smooth() -> None:
    assert resolution.due(NOTHING, 0.0) == 0
    assert resolution.due(COARSE, 0.05) == pytest.approx(resolution.STILL_AFTER - 0.05)
    assert resolution.due(COARSE, 1.0) == 0
    assert resolution.due(LARGE, 0.1) == pytest.approx(resolution.SMOOTH_AFTER - 0.1)
    assert resolution.due(LARGE + 3, 1.0) == 0
    assert resolution.due(DONE, 99.0) == math.inf


def test_samples_are_a_raster_of_which_each_four_lie_in_all_quarters() -> None:
    places = np.array(resolution.offsets())
    grid = (np.arange(4) + 0.5) / 4 - 0.5
    assert {tuple(p) for p in places} == set(itertools.product(grid, grid))
    for four in places.reshape(4, 4, 2):
        assert len({tuple(quarter) for quarter in four > 0}) == 4


# ---------------- cameras ----------------


def test_a_page_that_looks_as_a_test_view_does_sees_its_picture(scene: TrainedScene, data: Path) -> None:
    view = read_dataset(data, "test").views[0]
    pose = Pose.of_view(view)
    back = Pose.of_page(pose.page_rotation, pose.position, pose.fov, pose.aspect, view.near)
    assert np.abs(back.to_world - view.to_world).max() < 1e-12
    draw = scene.renderer(aovs=False)
    wanted = image_array(draw(view.camera()).radiance, view.height, view.width)
    found = image_array(draw(back.camera(view.width, view.height)).radiance, view.height, view.width)
    assert wanted.max() > 0.1
    assert np.abs(found - wanted).max() < 1e-5


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 2, 3)])
@pytest.mark.parametrize("degrees", [0, 90, 179.9, 180, 270])
def test_every_rotation_survives_the_page(axis: tuple[int, int, int], degrees: float) -> None:
    matrix = np.array(mi.ScalarTransform4f().rotate(axis, degrees).matrix, np.float64)
    matrix[:3, :3] = np.linalg.qr(matrix[:3, :3])[0] * np.sign(np.diag(np.linalg.qr(matrix[:3, :3])[1]))
    pose = Pose(matrix, 0.7, 1.0)
    again = Pose.of_page(pose.page_rotation, pose.position, 0.7, 1.0)
    assert np.abs(again.to_world - pose.to_world).max() < 1e-9


def test_oblong_pixels_see_what_square_ones_see() -> None:
    pose = Pose(np.eye(4), 0.8, 2.0)
    for width, height in ((160, 80), (128, 100)):
        camera = pose.camera(width, height)
        slope_x, slope_y = width / 2 / abs(camera.fx[0]), height / 2 / abs(camera.fy[0])
        assert slope_y == pytest.approx(math.tan(0.4))
        assert slope_x == pytest.approx(2 * math.tan(0.4))


def test_an_offset_moves_the_sample_that_way() -> None:
    x, y = Pose(np.eye(4), 0.8, 1.0).camera(8, 8, (0.25, -0.125)).rays().numpy()[:2].reshape(2, 8, 8)
    x0, y0 = Pose(np.eye(4), 0.8, 1.0).camera(8, 8).rays().numpy()[:2].reshape(2, 8, 8)
    step_x, step_y = x0[0, 1] - x0[0, 0], y0[1, 0] - y0[0, 0]
    assert np.allclose(x - x0, 0.25 * step_x, atol=1e-6)
    assert np.allclose(y - y0, -0.125 * step_y, atol=1e-6)


# ---------------- the loop ----------------


class Plain(ViewerScene):
    """A scene of one grey, which says what it was asked for."""

    variables, backdrops = ("image",), ("white",)
    centre, radius = np.zeros(3), 1.0

    def __init__(self) -> None:
        self.samples: list[SampleRequest] = []
        self.grey = 0.25
        self.during: Any = None

    def draw(self, sample: SampleRequest) -> SampleResult:
        self.samples.append(sample)
        if self.during is not None:
            self.during()
        one = mi.Float(1)
        return SampleResult([one * self.grey] * 3 + [one])


class Clock:
    """Time that passes when it is told to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def running() -> Iterator[tuple[RenderLoop, Plain, Clock, list[DeliveredImage]]]:
    """A loop with one visitor, who looks at nothing yet."""
    drawable, clock, seen = Plain(), Clock(), []  # type: ignore[var-annotated]
    loop = RenderLoop(drawable, clock)
    loop.enter(7, Client(seen.append))
    yield loop, drawable, clock, seen


POSE = Pose(np.eye(4), 0.7, 1.0)


def test_the_loop_waits_draws_small_then_large_then_smooth(running: Any) -> None:
    loop, drawable, clock, seen = running
    assert loop.step() == math.inf
    loop.change(7, pose=POSE, window=(640, 400))
    assert loop.step() == 0
    assert loop.step() == pytest.approx(resolution.STILL_AFTER)
    clock.now += resolution.STILL_AFTER + 1e-6
    assert loop.step() == 0
    assert loop.step() == pytest.approx(resolution.SMOOTH_AFTER - resolution.STILL_AFTER, abs=1e-5)
    clock.now += 1
    for _ in range(resolution.SAMPLES):
        assert loop.step() == 0
    assert loop.step() == math.inf
    assert [s.progress for s in seen] == [COARSE, LARGE, LARGE + 4, DONE]
    small, large = (
        resolution.size_of(resolution.COARSEST, 1.6),
        resolution.size_of(resolution.still_side(640, 400), 1.6),
    )
    assert [s.image.shape[1::-1] for s in seen] == [small, large, large, large]
    assert [sample.offset for sample in drawable.samples[2:]] == list(resolution.offsets())
    assert [sample.settled for sample in drawable.samples] == [False] + [True] * 17


def test_what_moves_meanwhile_drops_what_was_under_way(running: Any) -> None:
    loop, drawable, clock, seen = running
    loop.change(7, pose=POSE, window=(640, 400))
    loop.step()
    clock.now += 1
    drawable.during = lambda: loop.change(7, pose=replace(POSE, fov=0.8), window=(640, 400))
    loop.step()  # a large picture, of the view before
    drawable.during = None
    assert [s.progress for s in seen] == [COARSE]
    loop.step()
    assert [s.progress for s in seen] == [COARSE, COARSE]
    assert drawable.samples[-1].pose.fov == 0.8


def test_small_pictures_are_shown_while_it_keeps_moving(running: Any) -> None:
    """Each is old by the time that it is drawn."""
    loop, drawable, _, seen = running
    drawable.during = lambda: loop.change(
        7, pose=replace(POSE, fov=0.7 + 0.01 * len(drawable.samples)), window=(640, 400)
    )
    drawable.during()
    for _ in range(5):
        assert loop.step() == 0
    assert len(seen) == 5
    assert [sample.pose.fov for sample in drawable.samples] == [0.7 + 0.01 * i for i in range(5)]


def test_a_smooth_picture_is_the_mean_of_its_samples_and_starts_anew_after_a_change(running: Any) -> None:
    loop, drawable, clock, seen = running

    def encoded(grey: float) -> int:
        return round(255 * (1.055 * grey ** (1 / 2.4) - 0.055))

    loop.change(7, pose=POSE, window=(640, 400))
    loop.step()
    clock.now += 1
    for grey in (9.0, *[0.1, 0.3] * 8):
        drawable.grey = grey
        loop.step()
    assert (seen[-1].progress, seen[-1].image[0, 0, 0]) == (DONE, encoded(0.2))
    loop.change()
    for _ in range(8):  # stops amid the samples
        loop.step()
        clock.now += 1
    assert LARGE < seen[-1].progress < DONE
    loop.change()
    drawable.grey = 0.5
    loop.step()
    assert (seen[-1].progress, seen[-1].image[0, 0, 0]) == (COARSE, encoded(0.5))
    clock.now += 1
    for _ in range(17):
        loop.step()
    assert (seen[-1].progress, seen[-1].image[0, 0, 0]) == (DONE, encoded(0.5))


def test_notes_run_once_the_last_of_a_key_wins_and_bad_input_is_told(running: Any) -> None:
    loop, _, _, seen = running
    told: list[str] = []
    loop.report = told.append

    def bad() -> None:
        raise InputError("no such thing")

    done: list[int] = []
    loop.change(7, pose=POSE, window=(640, 400))
    loop.step()
    loop.submit("a", lambda: done.append(1))
    loop.submit("a", lambda: done.append(2))
    loop.submit("b", bad)
    loop.step()
    loop.step()
    assert (done, told) == ([2], ["no such thing"])
    assert [s.progress for s in seen] == [COARSE, COARSE]  # the first note changed what is seen


def test_a_failure_is_told_and_the_others_go_on(running: Any, capsys: pytest.CaptureFixture[str]) -> None:
    """Of a note and of a picture; a picture that fails is tried again only after a change."""
    loop, drawable, _, seen = running
    told: list[str] = []
    other: list[DeliveredImage] = []
    loop.report = told.append

    def broken() -> None:
        raise RuntimeError("out of memory\nand much more")

    loop.submit("a", broken)
    loop.submit("b", lambda: loop.change(7, pose=POSE, window=(640, 400)))
    drawable.during = broken
    assert loop.step() == 0
    assert loop.step() == math.inf
    assert (len(drawable.samples), len(told), seen) == (1, 2, [])
    assert all(message.startswith("out of memory; ") and "\n" not in message for message in told)
    assert capsys.readouterr().err.count("RuntimeError: out of memory\nand much more") == 2
    drawable.during = None
    loop.enter(8, Client(other.append))
    loop.change(8, pose=POSE, window=(640, 400))
    loop.step()
    assert (seen, [s.progress for s in other]) == ([], [COARSE])
    loop.change(7, pose=POSE, window=(640, 400))
    loop.step()
    assert [s.progress for s in seen] == [COARSE]


def test_a_picture_that_fails_after_a_change_is_drawn_anew(running: Any) -> None:
    loop, drawable, _, seen = running

    def moved_and_broken() -> None:
        drawable.during = None
        loop.change(7, pose=POSE, window=(640, 400))
        raise RuntimeError("gone")

    loop.change(7, pose=POSE, window=(640, 400))
    drawable.during = moved_and_broken
    assert loop.step() == loop.step() == 0
    assert [s.progress for s in seen] == [COARSE]


def test_who_sees_least_goes_first_and_who_left_is_forgotten(running: Any) -> None:
    loop, _, clock, seen = running
    other: list[DeliveredImage] = []
    loop.change(7, pose=POSE, window=(640, 400))
    loop.step()
    clock.now += 1
    loop.enter(8, Client(other.append))
    loop.change(8, pose=POSE, window=(640, 400))
    loop.step()
    assert (len(seen), len(other)) == (1, 1)
    loop.leave(7)
    clock.now += 1
    for _ in range(30):
        loop.step()
    assert (len(seen), other[-1].progress) == (1, DONE)


# ---------------- the scene that is shown ----------------


FROM_THE_FRONT = np.array([0.5**0.5, -(0.5**0.5), 0, 0])
"""Towards +y, z up: a page's camera looks along +z, y down, when it is not turned."""


def shown(drawable: ViewerScene, look: DisplayOptions, size: int = 40) -> np.ndarray:
    """A picture of the tiny scene from a side."""
    pose = Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.0)
    sample = SampleRequest(pose, size, size, look, settled=True)
    return to_bytes(displayed_planes(drawable.draw(sample).planes, look), size, size).astype(int)


def test_every_variable_that_a_scene_has_is_drawn(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    assert drawable.variables == (
        "image",
        "albedo",
        "metallic",
        "roughness",
        "normal",
        "depth",
        "alpha",
        "visibility",
        "diffuse",
        "specular",
        "indirect",
    )
    for name in drawable.variables:
        picture = shown(drawable, DisplayOptions(name, depths=(2.0, 4.0)))
        assert picture.shape == (40, 40, 3), name
        assert name == "indirect" or np.ptp(picture) > 0, name  # the balls have no such channel


def test_the_light_turns_by_the_angle_that_is_asked_for(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    before = shown(drawable, DisplayOptions())
    drawable.set_turn(90)
    # Directions of the world are turned back by the angle before the map is asked.
    x = drawable.light.radiance(mi.Vector3f(0, 1, 0)).numpy()  # type: ignore[union-attr]
    assert np.allclose(x, scene.light.prefilter().radiance(mi.Vector3f(1, 0, 0)).numpy(), rtol=1e-4)  # type: ignore[union-attr]
    assert np.abs(shown(drawable, DisplayOptions()) - before).max() > 3
    drawable.set_turn(0)
    assert np.array_equal(shown(drawable, DisplayOptions()), before)
    drawable.set_light(EnvironmentLight.constant(3.0, 8))
    assert np.abs(shown(drawable, DisplayOptions()) - before).max() > 3
    drawable.set_light(None)
    assert np.array_equal(shown(drawable, DisplayOptions()), before)


def test_materials_alone_are_those_of_relight_and_changes_stay_on_them(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    before = shown(drawable, DisplayOptions())
    drawable.set_relit(True)
    again = ReconstructionView(relightable(scene))
    assert np.array_equal(shown(drawable, DisplayOptions()), shown(again, DisplayOptions()))
    assert not np.array_equal(shown(drawable, DisplayOptions()), before)

    def black(given: TrainedScene) -> TrainedScene:
        raw = given.surfels.to_numpy()
        raw["albedo"][:] = -20
        return replace(given, surfels=Surfels.from_numpy(raw))

    drawable.set_changes([black])
    assert shown(drawable, DisplayOptions("albedo", backdrop="black")).max() == 0
    drawable.set_relit(False)
    assert shown(drawable, DisplayOptions("albedo", backdrop="black")).max() == 0
    drawable.set_changes([])
    assert np.array_equal(shown(drawable, DisplayOptions()), before)


def test_a_slider_sets_a_material_of_what_is_selected(scene: TrainedScene) -> None:
    metal = select(scene, Selection(where="metallic > 0.5"))
    change = Change(set=assignments({"roughness": 0.9, "metallic": 0.2}))
    rough = apply(scene, metal, change)
    drawable = ReconstructionView(scene)
    drawable.set_changes([lambda given: apply(given, metal, change)])
    assert np.array_equal(
        shown(drawable, DisplayOptions()), shown(ReconstructionView(rough), DisplayOptions())
    )
    assert (
        np.abs(shown(drawable, DisplayOptions()) - shown(ReconstructionView(scene), DisplayOptions())).max()
        > 20
    )


def test_exposure_and_backdrop_are_what_they_say(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    corner = [
        shown(drawable, DisplayOptions(backdrop=name))[0, 0].tolist() for name in ("white", "grey", "black")
    ]
    assert corner == [[255] * 3, [64] * 3, [0] * 3]
    light = shown(drawable, DisplayOptions(backdrop="environment map"))[0, 0]
    assert 0 < light.max()
    dark, bright = (
        shown(drawable, DisplayOptions(exposure=e, backdrop="black"))[20, 14].max() for e in (-3.0, 0.0)
    )
    assert 0 < dark < bright


@pytest.fixture
def surrounded(scene: TrainedScene) -> TrainedScene:
    """The first ball, the second as what surrounds it, and a grey background."""
    raw = scene.surfels.to_numpy()
    own = raw["position"][:, 0] < 0
    geometry = ("position", "rotation", "scale", "opacity", "radiance_sh")
    around = Surfels.from_numpy({name: raw[name][~own] for name in geometry})
    surfels = Surfels.from_numpy({name: table[own] for name, table in raw.items()})
    return replace(
        scene, surfels=surfels, surroundings=Surroundings(around, EnvironmentLight.constant(0.2, 8))
    )


def test_a_photographed_object_is_shown_in_its_surroundings_or_alone(surrounded: TrainedScene) -> None:
    drawable, alone = (
        ReconstructionView(surrounded),
        ReconstructionView(replace(surrounded, surroundings=None)),
    )
    assert drawable.backdrops == ("background", "white", "grey", "black", "environment map")
    assert alone.backdrops == ("white", "grey", "black", "environment map")
    whole = shown(drawable, DisplayOptions(backdrop="background"))
    assert whole[0, 0].tolist() == [124] * 3  # 0.2 as sRGB
    assert np.ptp(whole[:, 24:]) > 20  # the other ball
    for backdrop in alone.backdrops:
        assert np.array_equal(
            shown(drawable, DisplayOptions(backdrop=backdrop)),
            shown(alone, DisplayOptions(backdrop=backdrop)),
        )
    for name in ("alpha", "depth"):  # of what is shown
        some = DisplayOptions(name, backdrop="black", depths=(2.0, 4.0))
        assert np.array_equal(shown(drawable, some), shown(alone, some))
        assert not np.array_equal(shown(drawable, replace(some, backdrop="background")), shown(alone, some))


def test_what_is_saved_has_surroundings_or_is_transparent(surrounded: TrainedScene, tmp_path: Path) -> None:
    drawable, pose = (
        ReconstructionView(surrounded),
        Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.6),
    )
    found = {}
    for backdrop in ("background", "grey"):
        path = write_view(
            drawable, SampleRequest(pose, 32, 20, DisplayOptions(backdrop=backdrop)), tmp_path, ".exr"
        )
        found[backdrop] = read_exr_image(path)
    assert found["background"][..., 3].min() == 1
    assert np.allclose(found["background"][0, 0, :3], 0.2, rtol=1e-3)
    assert found["grey"][..., 3].min() == 0 and found["grey"][..., 3].max() > 0.9
    alone = replace(surrounded, surroundings=None).renderer(aovs=False, samples=16)(pose.camera(32, 20))
    assert np.abs(found["grey"] - image_array([*alone.radiance, alone.alpha], 20, 32)).max() < 1e-5


def test_a_scene_file_with_surroundings_is_shown_with_them_or_without(
    surrounded: TrainedScene, tmp_path: Path
) -> None:
    pose = Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.0)
    export(surrounded, tmp_path, pose.camera(24, 24))
    drawable, own = (
        MitsubaScene(load_scene(tmp_path / "scene.xml"), "scene.xml"),
        ReconstructionView(surrounded),
    )
    assert drawable.backdrops == ("background", "white", "grey", "black")
    for backdrop in drawable.backdrops:
        look = DisplayOptions(backdrop=backdrop)
        assert np.abs(shown(drawable, look) - shown(own, look)).max() <= 2, backdrop


def test_a_watched_fit_shows_its_object_alone_too(
    data: Path, method: Path, surrounded: TrainedScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer = Trainer(load(str(method), "quick", SETTINGS), read_dataset(data, "train"))
    drawable = Training(trainer)
    assert "background" not in drawable.backdrops
    before = shown(drawable, DisplayOptions())
    monkeypatch.setattr(Trainer, "surroundings", surrounded.surroundings)
    drawable = Training(trainer)
    assert drawable.backdrops == ("background", "white", "grey", "black")
    assert np.array_equal(shown(drawable, DisplayOptions()), before)
    assert np.abs(shown(drawable, DisplayOptions(backdrop="background")) - before).max() > 50


def test_truth_and_picture_stand_side_by_side_in_the_shape_of_the_window() -> None:
    left, right = np.full((30, 40, 3), 10, np.uint8), np.full((30, 40, 3), 20, np.uint8)
    for window in ((800, 400), (300, 900)):
        canvas = side_by_side([left, right], window)
        height, width = canvas.shape[:2]
        assert width / height == pytest.approx(window[0] / window[1], rel=0.02)
        row = canvas[height // 2, :, 0]
        assert (row == 10).sum() == (row == 20).sum() == 40
        assert np.flatnonzero(row == 20)[0] - np.flatnonzero(row == 10)[-1] == GAP + 1
        assert canvas[0, 0, 0] == round(255 * BORDER)
    for window in ((16384, 1), (1, 16384)):  # its shape would take gigabytes
        assert side_by_side([left, right], window).nbytes < 1e6


def test_views_are_saved_under_the_next_number_with_their_camera(scene: TrainedScene, tmp_path: Path) -> None:
    pose = Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.6)
    drawable, window = ReconstructionView(scene), (32, 20)
    paths = [
        write_view(drawable, SampleRequest(pose, *window, DisplayOptions()), tmp_path, suffix)
        for suffix in (".png", ".exr", ".json")
    ]
    assert [path.name for path in paths] == ["view_000.png", "view_001.exr", "view_002.json"]
    for split in ("train", "test"):
        (tmp_path / f"transforms_{split}.json").write_bytes((tmp_path / "view_000.json").read_bytes())
    view = read_dataset(tmp_path, "train").views[0].load()
    assert np.abs(view.to_world - pose.to_world).max() < 1e-6
    wanted = image_array(scene.renderer(aovs=False, samples=16)(view.camera()).alpha, 20, 32)
    assert wanted.max() > 0.9
    assert view.alpha is not None and np.abs(view.alpha - wanted).max() < 0.51 / 255


def test_a_saved_view_overwrites_no_file_and_takes_a_short_number(
    scene: TrainedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Files of others in the folder, and a file that another viewer makes at the same moment."""
    others = [
        f"view_{'9' * 200}.png",
        "view_0٣.png",
        "view_007.exr",
        "view_008",
        "view_009.json",
        "notes.txt",
    ]
    for name in others:
        (tmp_path / name).write_text(name)
    pose, drawable = Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.6), ReconstructionView(scene)
    (tmp_path / "view_010.json").symlink_to(tmp_path / "nowhere")
    listed, late = Path.iterdir, tmp_path / "view_011.json"

    def listed_before_another_came(folder: Path) -> Iterator[Path]:
        found = list(listed(folder))
        late.write_text(late.name)
        return iter(found)

    monkeypatch.setattr(Path, "iterdir", listed_before_another_came)
    saved = write_view(drawable, SampleRequest(pose, 32, 20, DisplayOptions()), tmp_path, ".png")
    monkeypatch.undo()
    assert saved.name == "view_012.png" and saved.with_suffix(".json").is_file()
    for name in (*others, late.name):
        assert (tmp_path / name).read_text() == name
    assert not (tmp_path / "nowhere").exists()

    for name in ("view_999999.png", "view_1000000.png"):
        (tmp_path / name).touch()
    assert (
        write_view(drawable, SampleRequest(pose, 32, 20, DisplayOptions()), tmp_path, ".json").name
        == "view_1000001.json"
    )

    def full(*_: Any) -> list[Any]:
        raise MemoryError

    before = sorted(tmp_path.iterdir())
    monkeypatch.setattr(drawable, "fine", full)
    with pytest.raises(MemoryError):
        write_view(drawable, SampleRequest(pose, 32, 20, DisplayOptions()), tmp_path, ".png")
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize("samples", [passes.PASS_SAMPLES, 2000])
def test_a_saved_picture_is_that_of_sixteen_samples(
    scene: TrainedScene, samples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whole, and in passes of two rows."""
    monkeypatch.setattr(passes, "PASS_SAMPLES", samples)
    pose = Pose.of_page(FROM_THE_FRONT, np.array([0, -3.0, 0]), 0.8, 1.6)
    path = write_view(
        ReconstructionView(scene), SampleRequest(pose, 32, 20, DisplayOptions()), tmp_path, ".exr"
    )
    monkeypatch.setattr(passes, "PASS_SAMPLES", 1 << 20)
    frame = scene.renderer(aovs=False, samples=16)(pose.camera(32, 20))
    assert np.abs(read_exr_image(path) - image_array([*frame.radiance, frame.alpha], 20, 32)).max() < 1e-5


# ---------------- bad input ----------------


def test_a_busy_port_is_one_sentence(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["view", str(finished), "--port", str(port)]) == 2
    message = capsys.readouterr().err.strip().splitlines()[-1]
    assert message.startswith(f"refgs: --port: 127.0.0.1:{port} cannot be used (")
    assert message.endswith("); give another --port")


@pytest.mark.parametrize(
    "option, value",
    [
        ("--port", "70000"),
        ("--host", "no.such.host.invalid"),
        ("--host", "300.1.1.1"),
        ("--host", "192.0.2.1"),  # an address of no machine: RFC 5737
    ],
)
def test_a_senseless_address_is_one_sentence_on_its_option(
    finished: Path, option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["view", str(finished), option, value]) == 2
    message = capsys.readouterr().err
    assert message.startswith(f"refgs: {option}: {value}")
    assert ("--port" in message) == (option == "--port")


def test_a_run_without_a_fit_says_how_to_fit_it(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = Run(tmp_path / "run")
    run.create(load("ref_gaussian", "quick"), str(data))
    assert main(["view", str(run.path), "--port", "0"]) == 2
    assert capsys.readouterr().err.endswith(f"`refgs train DATA -o {run.path} --resume`\n")


def test_without_viser_the_remedy_is_named(
    finished: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "viser", None)
    assert main(["view", str(finished)]) == 2
    assert capsys.readouterr().err == ('refgs: view: viser is not installed; pip install "mi_refgs[view]"\n')


# ---------------- Mitsuba scenes ----------------


def test_a_mitsuba_scene_of_a_run_is_drawn_like_the_run(finished: Path) -> None:
    drawable = MitsubaScene(load_scene(finished / "scene.xml", []), "scene.xml")
    own = ReconstructionView(TrainedScene.read(finished))
    assert drawable.variables == own.variables
    pose = drawable.start()
    for name in ("image", "normal", "roughness", "depth", "specular"):
        found, wanted = (
            to_bytes(
                displayed_planes(
                    each.draw(SampleRequest(pose, 24, 24, DisplayOptions(name))).planes, DisplayOptions(name)
                ),
                24,
                24,
            )
            for each in (drawable, own)
        )
        assert np.abs(found.astype(int) - wanted).max() <= 2, name
        assert np.ptp(wanted) > 0, name
    assert len(drawable.fine(SampleRequest(pose, 12, 10, DisplayOptions()))) == 4


def test_the_environment_of_a_path_traced_scene_turns() -> None:
    light = np.full((8, 16, 3), 0.1, np.float32)
    light[:, :8] = 2.0
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "hide_emitters": True},
            "ball": {"type": "sphere"},
            "sky": {
                "type": "envmap",
                "bitmap": mi.Bitmap(light),
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
            },
            "sensor": {
                "type": "perspective",
                "to_world": mi.ScalarTransform4f().look_at([0, -4, 0], [0, 0, 0], [0, 0, 1]),
            },
        }
    )
    drawable = MitsubaScene(loaded, "ball.xml")
    assert drawable.can_turn and drawable.variables == ("image",)
    assert drawable.radius == pytest.approx(3**0.5, rel=1e-3) and np.abs(drawable.centre).max() < 1e-3
    bright = []
    for degrees in (0.0, 90.0, 180.0, 360.0):
        drawable.set_turn(degrees)
        planes_found = drawable.fine(SampleRequest(drawable.start(), 16, 16, DisplayOptions()))
        bright.append(np.array(planes_found[0]).reshape(16, 16)[:, :8].sum())
    assert bright[0] == pytest.approx(bright[3], rel=0.05)
    assert max(bright) > 1.5 * min(bright)


# ---------------- a fit that is watched ----------------


def test_a_fit_draws_only_for_those_who_look_and_a_share_of_its_time(
    data: Path, method: Path, tmp_path: Path
) -> None:
    views = read_dataset(data, "train")
    trainer = Trainer(load(str(method), "quick", SETTINGS), views)
    clock = Clock()
    page = TrainingPage(trainer, Run(tmp_path), ("127.0.0.1", 0), clock)
    drawn: list[SampleRequest] = []
    draw = page.page.scene.draw

    def slow(sample: SampleRequest) -> SampleResult:
        drawn.append(sample)
        clock.now += 0.5
        return draw(sample)

    try:
        page.page.scene.draw = slow  # type: ignore[method-assign]
        for _ in range(20):
            clock.now += 0.1
            page.step()
        assert drawn == []
        seen: list[DeliveredImage] = []
        page.page.loop.enter(1, Client(seen.append))
        page.page.loop.change(1, pose=Pose.of_view(views.views[0]), window=(640, 400))
        for _ in range(100):
            clock.now += 0.1
            page.step()
        taken = 10 + 0.5 * len(drawn)
        assert 0.2 * taken < 0.5 * len(drawn) < 0.25 * taken + 0.6
        assert seen[0].image.std() > 1
    finally:
        page.page.close()


def test_the_curves_are_those_of_whole_lines(tmp_path: Path) -> None:
    log = tmp_path / "metrics.jsonl"
    assert read_log(log) == []
    log.write_text(
        '{"iteration": 1, "loss": 0.5, "psnr": 20}\n{"iteration": 2, "loss": 0.4}\n{"iteration": 3, '
    )
    assert [row["iteration"] for row in read_log(log)] == [1]
