"""The viewer without a browser: sizes and times of images, poses, the render loop, the displayed scenes."""

import itertools
import math
import socket
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import mitsuba as mi
import numpy as np
import pytest

from mi_refgs.data.dataset import read_dataset
from mi_refgs.editing.change import apply, assignments
from mi_refgs.editing.options import Selection
from mi_refgs.editing.selection import select
from mi_refgs.errors import InputError
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.images import to_8_bits
from mi_refgs.methods.read import load
from mi_refgs.render import passes
from mi_refgs.render.display import image_array
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.splat import Camera
from mi_refgs.viewer import resolution
from mi_refgs.viewer.loop import Client, RenderLoop
from mi_refgs.viewer.panels import light_of, write_view
from mi_refgs.viewer.pose import Pose
from mi_refgs.viewer.reconstruction_view import DisplayOptions, ReconstructionView, displayed_planes
from mi_refgs.viewer.resolution import COARSE, DONE, LARGE
from tests.helpers import ROOT, refused
from tests.scenes.known import with_background


@pytest.fixture
def photographed(scene: TrainedScene) -> TrainedScene:
    """One ball before the other as background and a grey map."""
    return with_background(scene, 0.2)


def test_sizes_have_the_area_and_the_shape_of_their_level() -> None:
    assert resolution.size_of(800, 1.0) == (800, 800)
    for side, shape in itertools.product(resolution.SIDES, resolution.SHAPES):
        width, height = resolution.size_of(side, shape)
        assert width % resolution.MULTIPLE == height % resolution.MULTIPLE == 0
        assert width * height == pytest.approx(side * side, rel=0.04)
        assert width / height == pytest.approx(shape, rel=0.04)


def test_a_window_gets_the_nearest_shape_and_area() -> None:
    windows = {(1280, 800): 1.6, (1920, 1000): 1.6, (800, 800): 1.0, (400, 900): 0.625}
    assert {window: resolution.shape_of(*window) for window in windows} == windows
    sides = {(800, 800): 800, (300, 200): 283, (3840, 2160): resolution.FINEST, (3840, 2160, 400): 400}
    assert {window: resolution.still_side(*window) for window in sides} == sides


def test_images_during_motion_fit_into_their_time() -> None:
    sides = {(283, 0.1, 1131): 200, (283, 0.03, 1131): 283, (283, 0.005, 1131): 400, (566, 0.001, 566): 566}
    sides[resolution.COARSEST, 9.0, 1131] = resolution.COARSEST
    assert {each: resolution.moving_side(*each) for each in sides} == sides


def test_samples_form_a_raster_and_each_four_cover_the_quarters() -> None:
    offsets = np.array([resolution.offset_of(i) for i in range(resolution.SAMPLES)])
    grid = (np.arange(4) + 0.5) / 4 - 0.5
    assert {tuple(p) for p in offsets} == set(itertools.product(grid, grid))
    for four in offsets.reshape(4, 4, 2):
        assert len({tuple(quarter) for quarter in four > 0}) == 4


def of_page(rotation: np.ndarray, position: np.ndarray, fov: float, aspect: float) -> Pose:
    """The pose of a camera of viser, which looks along +z, y down, before its rotation."""
    camera = {"wxyz": rotation, "position": position, "fov": fov}
    return Pose.of_page(SimpleNamespace(**camera, image_width=aspect * 1000, image_height=1000))


def front(aspect: float = 1.0) -> Pose:
    """Towards +y, z up."""
    return of_page(np.array([0.5**0.5, -(0.5**0.5), 0, 0]), np.array([0, -3.0, 0]), 0.8, aspect)


def test_a_page_at_the_pose_of_a_test_view_renders_its_image(scene: TrainedScene, data: Path) -> None:
    view = read_dataset(data, "test").views[0]
    pose = Pose.of_view(view)
    back = replace(of_page(pose.page_rotation, pose.position, pose.fov, pose.aspect), near=view.near)
    assert np.abs(back.to_world - view.to_world).max() < 1e-12
    draw, size = scene.renderer(aovs=False), (view.height, view.width)
    wanted = image_array(draw(view.camera()).radiance, *size)
    found = image_array(draw(back.camera(view.width, view.height)).radiance, *size)
    assert wanted.max() > 0.1 and np.abs(found - wanted).max() < 1e-5


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 2, 3)])
@pytest.mark.parametrize("degrees", [0, 90, 179.9, 180, 270])
def test_every_rotation_survives_the_page(axis: tuple[int, int, int], degrees: float) -> None:
    matrix = np.array(mi.ScalarTransform4f().rotate(axis, degrees).matrix, np.float64)
    q, r = np.linalg.qr(matrix[:3, :3])
    matrix[:3, :3] = q * np.sign(np.diag(r))
    pose = Pose(matrix, 0.7, 1.0)
    assert np.abs(of_page(pose.page_rotation, pose.position, 0.7, 1.0).to_world - pose.to_world).max() < 1e-9


def test_oblong_pixels_cover_the_field_of_view_of_square_ones_and_samples_are_offset() -> None:
    offset = (0.25, -0.125)
    for width, height in ((160, 80), (128, 100)):
        camera = Pose(np.eye(4), 0.8, 2.0).camera(width, height, offset)
        assert height / 2 / abs(camera.fy[0]) == pytest.approx(math.tan(0.4))
        assert width / 2 / abs(camera.fx[0]) == pytest.approx(2 * math.tan(0.4))
        assert (width / 2 - camera.cx[0], height / 2 - camera.cy[0]) == pytest.approx(offset, abs=1e-5)


class Plain(ReconstructionView):
    """A grey scene that records the requests."""

    variables, backdrops = ("image",), ("white",)
    centre, radius = np.zeros(3), 1.0

    def __init__(self) -> None:
        self.cameras: list[Camera] = []
        self.settled: list[bool] = []
        self.grey = 0.25
        self.during: Callable[[], None] = lambda: None  # called in each draw

    def draw(self, camera: Camera, look: DisplayOptions, settled: bool) -> list[Any]:
        self.cameras.append(camera)
        self.settled.append(settled)
        self.during()
        return [mi.Float(self.grey)] * 3 + [mi.Float(1)]

    def fovs(self) -> list[float]:
        return [2 * math.atan(camera.height / 2 / abs(camera.fy[0])) for camera in self.cameras]


class Clock:
    """Time that passes when it is told to."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


class Loop(RenderLoop):
    """A loop over a grey scene with client 7, which has no pose yet."""

    def __init__(self) -> None:
        self.plain, self.time = Plain(), Clock()
        super().__init__(self.plain, self.time)
        self.seen, self.reported = self.add(7), list[str]()
        self.report = self.reported.append

    def add(self, number: int) -> list[Any]:
        """Add a client; return the list of its images, each with progress and seconds."""
        seen: list[Any] = []
        self.clients[number] = Client(lambda *image: seen.append(image))
        return seen

    def move(self, number: int = 7, fov: float = 0.7) -> None:
        self.change(number, pose=Pose(np.eye(4), fov, 1.0), window=(640, 400))

    def steps(self, count: int, seconds: float = 0.0) -> None:
        for _ in range(count):
            self.step()
            self.time.now += seconds


@pytest.fixture
def loop() -> Loop:
    return Loop()


def progress(seen: list[Any]) -> list[int]:
    return [each for _, each, _ in seen]


def broken() -> None:
    raise RuntimeError("out of memory\nand much more")


def test_the_loop_waits_then_draws_coarse_large_and_supersampled(loop: Loop) -> None:
    assert loop.step() == math.inf
    loop.move()
    assert loop.step() == 0
    assert loop.step() == pytest.approx(resolution.STILL_AFTER)
    loop.time.now += resolution.STILL_AFTER + 1e-6
    assert loop.step() == 0
    assert loop.step() == pytest.approx(resolution.SMOOTH_AFTER - resolution.STILL_AFTER, abs=1e-5)
    loop.time.now += 1
    assert [loop.step() for _ in range(16)] == [0] * 15 + [math.inf]
    assert progress(loop.seen) == [COARSE, LARGE, LARGE + 3, DONE]
    still = resolution.still_side(640, 400)
    sizes = [resolution.size_of(side, 1.6) for side in (resolution.COARSEST, still, still, still)]
    assert [image.shape[1::-1] for image, _, _ in loop.seen] == sizes
    centres = [(c.width / 2 - c.cx[0], c.height / 2 - c.cy[0]) for c in loop.plain.cameras]
    wanted = [(0.0, 0.0), *(resolution.offset_of(i) for i in range(resolution.SAMPLES))]
    np.testing.assert_allclose(centres, wanted, atol=1e-4)
    assert loop.plain.settled == [False] + [True] * 16


def test_motion_drops_the_image_that_it_outdates(loop: Loop) -> None:
    loop.move()
    loop.steps(1, 1)
    loop.plain.during = lambda: loop.move(fov=0.8)
    loop.steps(1)  # a large image, of the view before
    loop.plain.during = lambda: None
    assert progress(loop.seen) == [COARSE]
    loop.steps(1)
    assert progress(loop.seen) == [COARSE, COARSE] and loop.plain.fovs()[-1] == pytest.approx(0.8)


def test_coarse_images_are_delivered_during_motion(loop: Loop) -> None:
    """Each is outdated by the time that it is drawn."""
    loop.plain.during = lambda: loop.move(fov=0.7 + 0.01 * len(loop.plain.cameras))
    loop.plain.during()
    assert [loop.step() for _ in range(5)] == [0] * 5 and len(loop.seen) == 5
    assert loop.plain.fovs() == pytest.approx([0.7 + 0.01 * i for i in range(5)])


def test_a_supersampled_image_is_the_mean_of_its_samples_and_restarts_after_a_change(loop: Loop) -> None:
    def last() -> tuple[int, int]:
        image, each, _ = loop.seen[-1]
        return each, image[0, 0, 0]

    def encoded(grey: float) -> int:
        return round(255 * (1.055 * grey ** (1 / 2.4) - 0.055))

    loop.move()
    loop.steps(1, 1)
    for grey in [0.1, 0.3] * 8:
        loop.plain.grey = grey
        loop.steps(1)
    assert last() == (DONE, encoded(0.2))
    loop.change()
    loop.steps(8, 1)  # ends between two samples
    assert LARGE < loop.seen[-1][1] < DONE
    loop.display(exposure=0.0)
    loop.plain.grey = 0.5
    loop.steps(1, 1)
    assert last() == (COARSE, encoded(0.5))
    loop.steps(16)
    assert last() == (DONE, encoded(0.5))


def test_the_last_task_of_a_key_runs_once_and_bad_input_is_reported(loop: Loop) -> None:
    done: list[int] = []
    loop.move()
    loop.steps(1)
    loop.submit("a", lambda: done.append(1))
    loop.submit("a", lambda: done.append(2))
    loop.submit("b", Mock(side_effect=InputError("no such thing")))
    loop.steps(2)
    assert (done, loop.reported) == ([2], ["no such thing"])
    assert progress(loop.seen) == [COARSE, COARSE]  # the first task changed the scene


def test_a_failure_is_reported_and_others_continue(loop: Loop, capsys: pytest.CaptureFixture[str]) -> None:
    """Failures of a task and of an image; a failed image is drawn again only after a change."""
    loop.submit("a", broken)
    loop.submit("b", loop.move)
    loop.plain.during = broken
    assert (loop.step(), loop.step()) == (0, math.inf)
    assert (len(loop.plain.cameras), len(loop.reported), loop.seen) == (1, 2, [])
    assert all(message.startswith("RuntimeError: ") and "\n" not in message for message in loop.reported)
    assert capsys.readouterr().err.count("RuntimeError: out of memory\nand much more") == 2
    loop.plain.during = lambda: None
    other = loop.add(8)
    loop.move(8)
    loop.steps(1)
    assert (loop.seen, progress(other)) == ([], [COARSE])
    loop.move()
    loop.steps(1)
    assert progress(loop.seen) == [COARSE]


def test_the_client_with_least_progress_goes_first_and_closed_pages_are_forgotten(loop: Loop) -> None:
    loop.move()
    loop.steps(1, 1)
    other = loop.add(8)
    loop.move(8)
    loop.steps(1, 1)
    assert (len(loop.seen), len(other)) == (1, 1)
    del loop.clients[7]
    loop.steps(30)
    assert (len(loop.seen), other[-1][1]) == (1, DONE)


def shown(scene: ReconstructionView | TrainedScene, what: str = "image", **options: Any) -> np.ndarray:
    """An image (40, 40, 3) of a scene from the front."""
    view = ReconstructionView(scene) if isinstance(scene, TrainedScene) else scene
    look = DisplayOptions(what, **options)
    planes = displayed_planes(view.draw(front().camera(40, 40), look, True), look, (2.0, 4.0))
    return to_8_bits(image_array(planes, 40, 40)).astype(int)


def test_every_variable_of_a_scene_is_drawn(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    maps = "image albedo metallic roughness normal depth alpha visibility diffuse specular indirect"
    assert drawable.variables == tuple(maps.split())
    for name in drawable.variables:
        image = shown(drawable, name)
        assert image.shape == (40, 40, 3), name
        assert name == "indirect" or np.ptp(image) > 0, name  # the balls have no such attribute


def test_the_light_rotates_by_the_given_angle_and_is_replaced(scene: TrainedScene) -> None:
    drawable = ReconstructionView(scene)
    before = shown(drawable)
    drawable.set_turn(90)
    # World directions are rotated back by the angle before the map is read.
    x = drawable.light.radiance(mi.Vector3f(0, 1, 0)).numpy()  # type: ignore[union-attr]
    assert np.allclose(x, scene.light.prefilter().radiance(mi.Vector3f(1, 0, 0)).numpy(), rtol=1e-4)  # type: ignore[union-attr]
    assert np.abs(shown(drawable) - before).max() > 3
    drawable.set_turn(0)
    assert np.array_equal(shown(drawable), before)
    drawable.set_light(EnvironmentLight.constant(3.0, 8))
    assert np.abs(shown(drawable) - before).max() > 3
    drawable.set_light(None)
    assert np.array_equal(shown(drawable), before)


def test_the_name_of_an_uploaded_light_is_not_used_as_a_path() -> None:
    """Its first bytes decide about its format."""
    content = (ROOT / "scenes" / "lights" / "sky.exr").read_bytes()
    for name in ("../light.exr", f"light.{'x' * 300}", "light.\0"):
        assert light_of(name, content, world=False).height == 128
        refused(partial(light_of, name, b"nothing", world=False), "not a readable image")


def test_relit_materials_are_those_of_relight_and_edits_stay(scene: TrainedScene) -> None:
    metal = select(scene, Selection(where="metallic > 0.5"))
    change = assignments({"roughness": 0.9, "metallic": 0.2})
    drawable = ReconstructionView(scene)
    before = shown(drawable)
    drawable.set_relit(True)
    assert np.array_equal(shown(drawable), shown(relightable(scene)))
    assert not np.array_equal(shown(drawable), before)
    drawable.set_change(lambda given: apply(given, metal, change))
    assert np.array_equal(shown(drawable), shown(apply(relightable(scene), metal, change)))
    drawable.set_relit(False)
    assert np.array_equal(shown(drawable), shown(apply(scene, metal, change)))
    assert np.abs(shown(drawable) - before).max() > 20
    drawable.set_change(None)
    assert np.array_equal(shown(drawable), before)


def test_exposure_is_in_stops_and_the_backdrop_is_behind_the_object(scene: TrainedScene) -> None:
    corners = [shown(scene, backdrop=name)[0, 0].tolist() for name in ("white", "grey", "black")]
    assert corners == [[255] * 3, [64] * 3, [0] * 3]
    assert 0 < shown(scene, backdrop="environment map")[0, 0].max()
    dark, bright = (shown(scene, exposure=stops, backdrop="black")[20, 14].max() for stops in (-3.0, 0.0))
    assert 0 < dark < bright


def test_a_photographed_object_is_displayed_with_or_without_background(photographed: TrainedScene) -> None:
    alone = replace(photographed, surroundings=None)
    backdrops = ReconstructionView(alone).backdrops
    assert backdrops == ("white", "grey", "black", "environment map")
    assert ReconstructionView(photographed).backdrops == ("background", *backdrops)
    whole = shown(photographed, backdrop="background")
    assert whole[0, 0].tolist() == [124] * 3  # 0.2 as sRGB
    assert np.ptp(whole[:, 24:]) > 20  # the other ball
    for backdrop in backdrops:
        assert np.array_equal(shown(photographed, backdrop=backdrop), shown(alone, backdrop=backdrop))
    for name in ("alpha", "depth"):
        ours, theirs, all_ = (
            shown(each, name, backdrop=backdrop)
            for each, backdrop in ((photographed, "black"), (alone, "black"), (photographed, "background"))
        )
        assert np.array_equal(ours, theirs) and not np.array_equal(ours, all_)


def saved(scene: TrainedScene, folder: Path, **options: Any) -> Path:
    """Save a view (20, 32) of a scene from the front; the path of its PNG."""
    return write_view(ReconstructionView(scene), front(1.6), (32, 20), DisplayOptions(**options), folder)


@pytest.mark.parametrize("samples", [passes.PASS_SAMPLES, 2000])
def test_a_saved_image_has_sixteen_samples_per_pixel_and_its_backdrop(
    photographed: TrainedScene, samples: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rendered at once, and in passes of two rows."""
    monkeypatch.setattr(passes, "PASS_SAMPLES", samples)
    whole, alone = (
        read_exr_image(saved(photographed, tmp_path, backdrop=name).with_suffix(".exr"))
        for name in ("background", "grey")
    )
    monkeypatch.setattr(passes, "PASS_SAMPLES", 1 << 20)
    assert whole[..., 3].min() == 1 and np.allclose(whole[0, 0, :3], 0.2, rtol=1e-3)
    assert alone[..., 3].min() == 0 and alone[..., 3].max() > 0.9
    draw = replace(photographed, surroundings=None).renderer(aovs=False, samples=16)
    frame = draw(front(1.6).camera(32, 20))
    assert np.abs(alone - image_array([*frame.radiance, frame.alpha], 20, 32)).max() < 1e-5


def test_views_are_numbered_and_saved_with_their_camera(scene: TrainedScene, tmp_path: Path) -> None:
    (tmp_path / "view_001.exr").touch()
    paths = [saved(scene, tmp_path), saved(scene, tmp_path, what="normal")]
    assert [path.name for path in paths] == ["view_000.png", "view_002.png"]
    for split in ("train", "test"):
        (tmp_path / f"transforms_{split}.json").write_bytes((tmp_path / "view_000.json").read_bytes())
    view = read_dataset(tmp_path, "train").views[0].load()
    assert np.abs(view.to_world - front().to_world).max() < 1e-6
    wanted = image_array(scene.renderer(aovs=False, samples=16)(view.camera()).alpha, 20, 32)
    assert wanted.max() > 0.9
    assert view.alpha is not None and np.abs(view.alpha - wanted).max() < 0.51 / 255
    normal = read_exr_image(tmp_path / "view_002.exr")
    assert np.allclose(np.linalg.norm(normal[..., :3], axis=-1)[normal[..., 3] > 0.5], 1, atol=1e-3)


def test_a_busy_port_is_refused(finished: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        refused(["view", finished, "--port", taken.getsockname()[1]], "--port: ")


def test_a_run_without_a_fit_is_refused(data: Path, tmp_path: Path) -> None:
    run = Run(tmp_path / "run")
    run.create(load("ref_gaussian", "quick"), str(data))
    refused(["view", run.path, "--port", "0"], f"`refgs train DATA -o {run.path} --resume`")


def test_a_missing_viser_is_refused(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    refused(["view", finished], 'view: viser is not installed; pip install "mi_refgs[view]"')
