"""The fit of images without alpha: what it starts from, its two tables, checkpoints, the default method."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from mi_refgs import methods
from mi_refgs.data.dataset import READERS, Dataset, PointCloud, read_dataset
from mi_refgs.data.images import ImageFile, Pixels
from mi_refgs.data.object_region import in_free_space
from mi_refgs.data.region import REGION_FILE, Region
from mi_refgs.data.view import View
from mi_refgs.fitting.events import densify as densify_event, open_scene
from mi_refgs.fitting.events.densify import Densify
from mi_refgs.fitting.events.resets import ResetOpacity
from mi_refgs.fitting.exchange import depth_outside, exchange, exchanged
from mi_refgs.fitting.initial import initial_parameters
from mi_refgs.fitting.photographed_light import PhotographedLight
from mi_refgs.fitting.row_rates import of_diffuse_colour
from mi_refgs.fitting.runner import Choice, begin, chosen
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.methods.fields import Window
from mi_refgs.methods.method import AROUND, LossWeight, Method, SurroundingsOptions
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.reference.camera import look_at
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.run import Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import views_of_run
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.light.lobe_matrices import map_directions
from mi_refgs.surfels.attributes import sigmoid
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, unit
from tests.scenes.highlight import require_same_state, set_rows, step_to, without
from tests.scenes.layouts import change_transforms
from tests.scenes.splats import opaque
from tests.scenes.tiny import METHOD, REGION, write_data, write_method, write_open_data

STEPS = 12


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Eight views of the tiny ball in front of a coloured sky, without alpha."""
    return read_dataset(write_open_data(tmp_path_factory.mktemp("open") / "data"), "train")


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> Method:
    """The tiny method with surroundings, edits of the tables and a reset."""
    path = write_method(tmp_path_factory.mktemp("method"), METHOD + "[surroundings]\ndegree = 1\n")
    settings = [
        f"iterations={STEPS}", "surfels.count=80", "surfels.max_count=100",
        "surroundings.count=60", "surroundings.max_count=90", "log_every=4",
        "event.densify.when={ start = 0, until = 10, every = 4 }",
        "event.reset_opacity.when={ start = 0, until = 6, every = 6 }", "loss.normal=0.1",
        "event.photograph_light.when={ start = 0, until = 10, every = 4 }", "loss.photographed=1",
    ]  # fmt: skip
    return methods.load(str(path), "quick", settings)


def test_initial_parameters_of_open_scene(data: Dataset, method: Method) -> None:
    """Small surfels in the region, others outside with sizes that grow with distance; no material columns."""
    without = replace(method, surroundings=None)
    assert FitSetup(method, data).open_scene and not FitSetup(without, data).open_scene
    params = initial_parameters(method, data, np.random.default_rng(0), True)
    inner, outer = params["position"].numpy(), params["surroundings/position"].numpy()
    assert np.all(REGION.contains(inner)) and not np.any(REGION.contains(outer))
    names = {name.removeprefix("surroundings/") for name in params if name.startswith("surroundings/")}
    assert names == {"position", "rotation", "scale", "opacity", "radiance_sh"}
    assert method.surroundings is not None
    for name in ("opacity", "surroundings/opacity"):  # nearly transparent: images show through the cloud
        np.testing.assert_allclose(sigmoid(params[name].numpy()), method.surroundings.opacity, atol=1e-6)
    size = np.exp(params["surroundings/scale"].numpy()).max(axis=1)
    assert np.all(size <= 1.001 * method.surroundings.size * np.linalg.norm(outer, axis=1))
    assert np.exp(params["scale"].numpy()).max() < REGION.radius
    assert np.mean(np.any([view.project(outer)[2] for view in data.views], axis=0)) > 0.99
    # The sky is 0.5 + 0.3 d in the direction d, encoded; what no view sees is grey.
    trainer = Trainer(method, data)
    assert [table.max_count for table in trainer.fit.tables] == [48, 142]  # a quarter of 190
    scene = TrainedScene.from_state(method, trainer.fit.arrays())
    assert scene.surroundings is not None and scene.surroundings.background is not None
    assert np.ptp(scene.surroundings.background.radiance().numpy(), axis=(0, 1)).max() < 1e-6
    assert scene.light is not None
    sky = scene.light.radiance().numpy()
    seen = np.abs(sky - 0.5).max(axis=-1) > 1e-3
    error = np.abs(sky - linear_from_srgb(0.5 + 0.3 * map_directions(8))).max(axis=-1)[seen]
    assert 0.1 < seen.mean() < 0.9 and np.mean(error < 0.05) > 0.2  # the ball hides the rest


def test_points_keep_to_their_side(data: Dataset, method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SurroundingsOptions, "scattered", 0.0)
    near, far = np.array([0.4, 3])[:, None, None] * unit(np.random.default_rng(1).normal(size=(2, 30, 3)))
    colour = np.concatenate([np.tile([1.0, 0, 0], (30, 1)), np.tile([0, 0, 1.0], (30, 1))])
    known = replace(data, points=PointCloud(np.concatenate([near, far]), colour))
    assert method.surroundings is not None
    surfels, around = replace(method.surfels, inside=0.0, count=30), replace(method.surroundings, count=30)
    no_random = replace(method, surfels=surfels, surroundings=around)
    params = initial_parameters(no_random, known, np.random.default_rng(0), True)
    np.testing.assert_allclose(np.sort(params["position"].numpy(), axis=0), np.sort(near, axis=0), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(params["surroundings/position"].numpy(), axis=1), 3, rtol=1e-5)
    assert params["radiance_sh"].numpy()[:, 0].min() > params["surroundings/radiance_sh"].numpy()[:, 0].max()
    half = replace(no_random, surfels=replace(no_random.surfels, inside=0.5))
    mixed = initial_parameters(half, known, np.random.default_rng(0), True)["position"].numpy()
    assert np.mean(np.abs(np.linalg.norm(mixed, axis=1) - 0.4) < 1e-5) == pytest.approx(0.5)


RNG = np.random.default_rng(0)
BEHIND = SurroundingsOptions("surfel", degree=0).names  # columns of a background of surfels


def table(method: Method, places: Any, size: float = 0, degree: int = 0, behind: bool = False) -> Surfels:
    """Random surfels at places (N, 3), or (N,) radii along x; with a size upright and of this one."""
    rng, names = np.random.default_rng(behind), BEHIND if behind else method.surfels.names
    raw = {n: rng.normal(size=(len(places), method.surfels.columns(n))) for n in names}
    raw["radiance_sh"] = rng.normal(size=(len(places), 3 * (degree + 1) ** 2))
    raw["position"] = np.array(places) if np.ndim(places) > 1 else np.outer(places, [REGION.radius, 0, 0])
    if size:
        raw |= {"scale": np.full((len(places), 2), np.log(size)), "rotation": np.eye(4)[[0] * len(places)]}
    return Surfels.from_numpy(raw)


def test_surfels_beyond_border_change_tables(method: Method) -> None:
    """Beyond the margin; with their geometry and SH, and without history; one stays."""
    inner = table(method, [0.2, 0.9, 1.01, 1.2, 5.0], degree=1)
    outer = table(method, [2.0, 0.5, 0.99, 1.5], behind=True)
    own, other = exchanged(inner, outer, method, REGION, RNG, True)
    distance = own.surfels.to_numpy()["position"][:, 0] / REGION.radius
    np.testing.assert_allclose(distance, [0.2, 0.9, 1.01, 0.5, 0.99], rtol=1e-5)
    beyond = other.surfels.to_numpy()["position"][:, 0] / REGION.radius
    np.testing.assert_allclose(beyond, [2.0, 1.5, 1.2, 5.0], rtol=1e-5)
    assert own.parent[:3].tolist() == [0, 1, 2] and own.fresh.tolist() == [False] * 3 + [True] * 2
    assert {*other.surfels.raw} == {*BEHIND} and other.fresh.tolist() == [False] * 2 + [True] * 2
    before, after = inner.to_numpy(), other.surfels.to_numpy()
    np.testing.assert_array_equal(after["scale"][2:], before["scale"][3:])
    np.testing.assert_array_equal(after["radiance_sh"][2:], before["radiance_sh"][3:, :3])
    entered = own.surfels.to_numpy()
    np.testing.assert_array_equal(entered["radiance_sh"][3, :3], outer.to_numpy()["radiance_sh"][1])
    assert np.all(entered["radiance_sh"][3, 3:] == 0)
    assert sigmoid(entered["metallic"][3, 0]) == pytest.approx(method.surfels.first("metallic"))

    full = replace(method, surfels=replace(method.surfels, max_count=3))
    assert exchanged(inner, outer, full, REGION, RNG, True)[0].surfels.count == 5  # for two came and two left
    gone = table(method, [2.0, 3.0], degree=1)
    assert exchanged(gone, outer, method, REGION, RNG, True)[0].surfels.count == 3  # one left, two came


def test_surfels_become_thin_gaussians_and_back(method: Method) -> None:
    """The plane and its deviations stay; a Gaussian becomes the surfel across its shortest axis."""
    rng = np.random.default_rng(2)
    names = SurroundingsOptions(degree=0).names
    raw = {n: rng.normal(size=(2, method.surfels.columns(n))) for n in method.surfels.names}
    raw["position"] = np.array([[0, 0, 0.2], [9.0, 0, 0]])
    around = {n: rng.normal(size=(2, 4 if n == "rotation" else 3 if n != "opacity" else 1)) for n in names}
    around["position"] = np.array([[9.0, 0, 0], [0.1, 0, 0]])
    around["scale"][1] = np.log([0.01, 0.3, 0.2])
    inner, outer = Surfels.from_numpy(raw), Surfels.from_numpy(around)
    own, other = (edit.surfels for edit in exchanged(inner, outer, method, REGION, RNG, True))
    assert (own.primitive.name, other.primitive.name) == ("surfel", "gaussian")

    def spread(surfels: Surfels, row: int) -> tuple[np.ndarray, np.ndarray]:
        axes, deviations = surfels.primitive.extent(surfels.to_numpy())
        return axes[row], deviations[row]

    axes, deviations = spread(own, 1)  # that came from the background
    before, _ = spread(outer, 1)
    np.testing.assert_allclose(deviations, [0.3, 0.2], rtol=1e-5)
    np.testing.assert_allclose(np.abs(np.sum(axes * before[1:], axis=1)), 1, atol=1e-5)
    axes, deviations = spread(other, 1)  # that left the object
    before, flat = spread(inner, 1)
    np.testing.assert_allclose(deviations, [flat.max(), flat.min(), 0.1 * flat.min()], rtol=1e-5)
    np.testing.assert_allclose(np.abs(axes[2] @ np.cross(*before)), 1, atol=1e-5)


def test_small_parts_are_background(method: Method) -> None:
    """Once the region follows the object: those apart from it leave, or do not come; but for single ones."""
    ball, bit = 0.2 * unit(RNG.normal(size=(300, 3))), RNG.normal([0.6, 0, 0], 0.01, size=(24, 3))
    sheet = [[x / 80, y / 80, -0.5] for x in range(-7, 8) for y in range(-7, 8)]
    inner = table(method, [*ball, *sheet, *bit, [0, 0, 0.6]], 0.01)
    outer = table(method, [*-bit, *ball[:5] / 2], 0.01, behind=True)
    setup = Mock(method=method, data=Mock(region=REGION), rng=lambda *_: RNG)
    for found, counts in ((None, [578, 1]), (REGION, [531, 48])):
        tables = [Mock(surfels=inner), Mock(surfels=outer)]
        exchange(setup, Mock(region=found, tables=tables))
        own, other = (one.apply.call_args.args[0].surfels for one in tables)
        assert [own.count, other.count] == counts
    assert abs(other.to_numpy()["position"][:, 0]).min() > 0.5


def test_surfels_below_planes_change_tables(method: Method) -> None:
    """Those of the object with centres below a plane of the region; of the background, what is above all."""
    region = replace(REGION, planes=((0.0, 0.0, 1.0, 0.1), (1.0, 0.0, 0.0, -0.5)))
    inner = table(method, [[0, 0, 0.4], [0, 0, 0.05], [-0.6, 0, 0.2], [0, 0, 0.095]], 1e-4)
    outer = table(method, [[0, 0, 0], [0, 0.1, 0.3], [0, 0, 0.105]], 1e-4, behind=True)
    edits = exchanged(inner, outer, method, region, RNG, True)
    own, other = (edit.surfels.to_numpy()["position"] for edit in edits)
    inside = [[0.0, 0.0, 0.4], [0.0, 0.0, 0.095], [0.0, 0.1, 0.3], [0.0, 0.0, 0.105]]
    np.testing.assert_allclose(own, inside, atol=1e-6)
    np.testing.assert_allclose(other, [[0.0, 0.0, 0.0], [0.0, 0.0, 0.05], [-0.6, 0.0, 0.2]], atol=1e-6)
    # Tangents along x and y, deviations of 0.1: some extend through the second plane, none through the first.
    through = [[0.0, 0.0, 0.2], [-0.45, 0.0, 0.2], [0.0, 0.0, -1.0]]
    wide, others = table(method, through[:2], 0.1), table(method, through, 0.1, behind=True)
    edits = exchanged(wide, others, method, region, RNG, True)
    own, other = (edit.surfels.to_numpy()["position"] for edit in edits)
    np.testing.assert_allclose(own, [*through[:2], through[0]], atol=1e-6)
    np.testing.assert_allclose(other, through[1:], atol=1e-6)


def test_points_start_on_their_side_of_planes(data: Dataset, method: Method) -> None:
    region = replace(REGION, planes=((0.0, 0.0, 1.0, 0.1),))
    params = initial_parameters(method, replace(data, region=region), np.random.default_rng(0), True)
    inner, outer = params["position"].numpy(), params["surroundings/position"].numpy()
    assert np.all(region.contains(inner)) and not np.any(region.contains(outer))
    assert np.any(REGION.contains(outer))  # below the plane, too
    empty = replace(data, region=replace(region, planes=((0.0, 0.0, 1.0, 0.8),)))
    refused(lambda: initial_parameters(method, empty, np.random.default_rng(0), True), "hardly anything")


def test_points_of_a_surface_are_where_depth_is_level_and_opaque() -> None:
    """A near square in front of a far plane, without the mixed depths at its outline and a hole."""
    origin = np.array([3.0, -2.0, 1.5])
    pose, pixels = look_at(origin, np.array([0.2, 0.1, -0.3])), Pixels(np.zeros((40, 60, 3), np.float32))
    view = View("v", 60, 40, 70.0, 75.0, 28.0, 21.0, pose, pixels)
    depth, alpha = np.full((40, 60), 6.0), np.ones((40, 60))
    depth[10:20, 20:30] = 3.0
    depth[9, 20:30] = np.linspace(3.5, 5.5, 10)
    alpha[30:35, 40:50] = 0.3
    points = open_scene.surface_points(view, depth.ravel(), alpha.ravel(), 1.0)
    row, column, seen = view.project(points)
    assert seen.all() and {*np.round((points - origin) @ pose[:3, 2], 6)} == {3.0, 6.0}
    found = np.zeros((40, 60), bool)
    found[np.rint(row).astype(int), np.rint(column).astype(int)] = True
    assert found[10:20, 20:30].all() and not found[9, 20:30].any() and not found[30:35, 40:50].any()
    assert np.sum(~found) < 10 + 50 + 12


def test_region_follows_object_once(data: Dataset, method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """After a third of the fit, unless a user gave the region; a checkpoint has it, and edits use it."""
    found = replace(REGION, radius=0.5, planes=((0.0, 0.0, 1.0, 0.0),), estimated=True)
    fitted, said = Mock(return_value=found), list[str]()
    monkeypatch.setattr(open_scene, "fitted_region", fitted)
    step_to(Trainer(method, data), STEPS // 2)
    assert not fitted.called  # region.json
    guessed = replace(data, region=replace(REGION, estimated=True))
    trainer = step_to(Trainer(method, guessed, tell=said.append), STEPS // 3 + 1)
    assert fitted.call_count == len(said) == 1 and trainer.region == found and "0.5 units" in said[0]
    assert depth_outside(trainer.surfels.to_numpy()["position"], found).max() < 0.05
    resumed = Trainer(method, guessed, state=trainer.fit.arrays())
    step_to(resumed, STEPS // 2)
    assert resumed.region == found and fitted.call_count == 1
    monkeypatch.setattr(open_scene, "fitted_region", lambda *_: None)
    same = step_to(Trainer(method, guessed, tell=said.append), STEPS // 3 + 1)
    assert same.region == REGION and "stays" in said[-1]


def test_region_that_no_view_shows_is_refused(data: Dataset, method: Method, tmp_path: Path) -> None:
    for region in (Region((0.0, 0.0, 50.0), 0.5), replace(REGION, planes=((0.0, 0.0, 1.0, 5.0),))):
        other = replace(data, region=region)
        refused(lambda: begin(method, other, Run(tmp_path / "run")), "no view shows the region")  # noqa: B023


def test_region_is_adapted_to_points_when_fit_begins(data: Dataset, method: Method, tmp_path: Path) -> None:
    """The run records it, and a resumed fit does not complain that the cameras suggest another one."""
    rng, said = np.random.default_rng(0), list[str]()
    floor = rng.uniform(-1.2, 1.2, (1500, 3)) * [1, 1, 0] - [0, 0, 0.6]
    cameras = replace(data, region=replace(REGION, estimated=True), points=PointCloud(floor, None))
    run = Run(tmp_path / "run")
    trainer = begin(method, cameras, run, said.append)
    assert run.region() == trainer.region is not None and len(trainer.region.planes) == 1
    again = begin(method, replace(data, region=replace(REGION, estimated=True)), run, said.append)
    assert again.region == trainer.region and not any("changed" in text for text in said)
    said.clear()
    tall = PointCloud(rng.normal(size=(1500, 3)) * [0.05, 0.05, 0.2])  # no plane supports it
    small = replace(cameras, region=replace(REGION, radius=0.3, estimated=True), points=tall)
    begin(method, small, Run(tmp_path / "tall"), said.append)
    assert any("grown" in text for text in said) and not any("plane" in text for text in said)


def test_surfels_without_weight_are_removed_from_their_own_table(
    data: Dataset, method: Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Transparent ones of the object and of the background have no weight in any view; others have."""
    trainer, hidden = Trainer(method, data), (np.arange(5), np.arange(20, 32))
    for table, rows in zip(trainer.fit.tables, hidden, strict=True):
        set_rows(table, "opacity", rows, -10)
    edit = Mock(wraps=densify_event.densify_and_prune)
    monkeypatch.setattr(densify_event, "densify_and_prune", edit)
    trainer.fit.iteration = 4
    trainer.method.event["densify"].apply(trainer)
    for call, count, rows in zip(edit.call_args_list, (80, 60), hidden, strict=True):
        faint = call.kwargs["faint"]
        assert np.isin(rows, faint).all() and len(faint) < count / 2


def test_background_before_what_views_show_floats(data: Dataset, method: Method) -> None:
    """Faint surfels of the background half way to a ball in a shell; not opaque ones with faint fringes."""
    trainer, eyes = Trainer(method, data), [data.views[i].to_world[:3, 3] for i in (3, 0)]
    shell = map_directions(8).reshape(-1, 3)[np.linspace(0, 127, 80, dtype=int)]
    for table, radius in zip(trainer.fit.tables, (0.5, 6), strict=True):
        raw = table.surfels.to_numpy()
        raw["position"] = (radius * shell[: table.surfels.count]).astype(np.float32)
        raw["opacity"][:], raw["scale"][:] = 5, np.log(radius / 6)
        raw["position"][:14], raw["opacity"][:7], raw["scale"][7:14] = np.repeat(eyes, 7, axis=0) / 2, -2, -3
        table.replace(Surfels.from_numpy(raw))
    assert [gone.tolist() for _, gone in Densify(Window(0, 1, 1))._weighed(trainer)] == [[], [*range(7)]]
    initial = initial_parameters(method, data, np.random.default_rng(0), True)[f"{AROUND}position"].numpy()
    assert not in_free_space(data.views, REGION, initial).any()


def test_nothing_faint_is_removed_soon_after_a_reset(data: Dataset, method: Method) -> None:
    """Transparent surfels without weight stay in a full table: opacities have not had the time to rise."""
    densify = Densify(Window(0, 10, 4), prune_extent=10.0)
    for events, left in (({"reset_opacity": ResetOpacity(Window(0, 3, 3))}, 5), ({}, 0)):
        full = replace(method.surfels, max_count=method.surfels.count)
        trainer = Trainer(replace(method, event={"densify": densify, **events}, surfels=full), data)
        table = trainer.fit.tables[0]
        set_rows(table, "opacity", slice(5), -10)
        trainer.fit.iteration = 4
        trainer.happen()
        opacity = table.surfels.raw["opacity"].numpy()
        assert np.sum(opacity < -9) == left and len(opacity) > 50


def test_resume_repeats_straight_run_bit_for_bit(data: Dataset, method: Method, one_thread: None) -> None:
    """Both tables, the background and their history, across edits of the tables."""
    straight = step_to(Trainer(method, data), 5)
    resumed = Trainer(method, data, state=straight.fit.arrays())
    found = require_same_state(step_to(straight, STEPS), step_to(resumed, STEPS))
    assert "optimiser/surroundings/scale/first" in found
    assert len(found["params/surroundings/position"]) != 60  # it was edited


def test_run_keeps_region_that_it_was_started_with(data: Dataset, method: Method, tmp_path: Path) -> None:
    """However region.json is edited: a resumed fit says so, and what evaluates the run goes by its own. Other
    cameras are another world: no fit goes on with them, and what reads them warns."""
    folder, run, said = shutil.copytree(data.path, tmp_path / "data"), Run(tmp_path / "run"), list[str]()
    begin(method, read_dataset(folder, "train"), run)
    assert run.region() == REGION
    begin(method, read_dataset(folder, "train"), run, said.append)
    assert not any("changed" in text for text in said) and views_of_run(run, method, "test").region == REGION
    assert begin(method, read_dataset(folder, "train").relative_to([5, 0, 0]), run).data.offset == (0, 0, 0)
    smaller = replace(REGION, radius=0.3)
    run.write_dataset(str(folder), smaller)  # it followed the object: cameras turn about the first one
    assert begin(method, read_dataset(folder, "train"), run).setup.data.region == REGION
    assert run.region() == smaller == views_of_run(run, method, "test").region
    run.write_dataset(str(folder), REGION)
    for text in ('{"centre": [0, 0, 0.1], "radius": 0.7}', '{"centre": [0, 0, 0], "radius": 0.5}', None):
        file = folder / REGION_FILE
        file.unlink()
        file.symlink_to("nowhere") if text is None else file.write_text(text)
        said.clear()
        resumed = begin(method, read_dataset(folder, "train"), run, said.append)
        assert resumed.data.region == REGION and views_of_run(run, method, "test").region == REGION
        assert sum("region: it has changed" in text for text in said) == 1
    change_transforms(folder, lambda made: made["frames"][1].update(fl_x=30.0), "train")
    refused(lambda: begin(method, read_dataset(folder, "train"), run), "1 of 8 images or cameras")
    for read in (lambda: views_of_run(run, method, "test"), lambda: Provenance.of(run).views("test")):
        with pytest.warns(RuntimeWarning, match="1 images or cameras are not as when the fit began"):
            read()
    assert views_of_run(run, method, "test", folder).views  # named: taken as it is
    (run.path / "dataset.json").write_text(json.dumps({"path": str(folder), "region": {"radius": 1}}))
    refused(lambda: views_of_run(run, method, "test"), "dataset.json: centre, radius")


def test_resume_with_other_images_changes_nothing(data: Dataset, method: Method, tmp_path: Path) -> None:
    """Images with alpha for an open run, and the reverse: the message names both folders."""
    closed = read_dataset(write_data(tmp_path / "alpha", truth=False), "train")
    for name, own, other in (("open", data, closed), ("closed", closed, data)):
        run = Run(tmp_path / name)
        run.save_checkpoint(0, begin(method, own, run).fit.arrays())
        before = (run.path / "dataset.json").read_bytes()
        refused(["train", other.path, "-o", run.path, "--resume"], other.path, run.path)
        assert (run.path / "dataset.json").read_bytes() == before
    first, *rest = closed.views
    turned = replace(first, to_world=first.to_world @ np.diag([-1, -1, 1, 1]))
    for other in (replace(closed, views=tuple(x)) for x in (rest, [turned, *rest])):
        refused(lambda: begin(method, other, run), run.path, "1 of 3 images")  # noqa: B023


def test_fit_of_open_scene_improves(data: Dataset, method: Method) -> None:
    """Object, surroundings and background learn; whatever is of alpha has no part in it."""
    trainer = Trainer(replace(without(method), iterations=100), data)
    start = {name: np.array(x) for name, x in trainer.fit.arrays().items() if name.startswith("params/")}
    errors = []
    for _ in range(80):
        trainer.step()
        errors.append(float(trainer.error[0]))
    assert np.mean(errors[-8:]) < 0.7 * np.mean(errors[:8])
    end = trainer.fit.arrays()
    for name in ("params/background", "params/light"):
        assert np.abs(end[name] - start[name]).max() > 1e-3, name
    assert trainer.health.skipped == 0 and all(np.isfinite(x).all() for n, x in end.items() if n in start)


def test_light_follows_photographs(data: Dataset, method: Method, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where views show the background, but not behind them; rendered in the iterations of the window."""
    rendered: dict[int, PhotographedLight] = {}
    first = PhotographedLight.of
    counted = staticmethod(lambda *given: rendered.setdefault(trainer.iteration, first(*given)))
    monkeypatch.setattr(PhotographedLight, "of", counted)
    loss, rates = method.loss | {"photographed": LossWeight(100.0)}, replace(method.rates, light=0.3)
    trainer = Trainer(replace(method, loss=loss, rates=rates), data)
    step_to(trainer, 4)
    known = trainer.fit.photographed
    assert known is not None and [*rendered] == [4]
    off = []
    for iteration in (4, 8):
        light = step_to(trainer, iteration).fit.light
        assert light is not None
        off.append(float(known.difference(light.prefilter())[0]))
    assert [*rendered] == [4, 8] and off[1] < 0.8 * off[0]
    assert known.weight.max() == 1 and known.weight.min() == 0
    assert step_to(Trainer(without(method, "photograph_light"), data), 5).fit.photographed is None


def test_hidden_background_does_not_count(data: Dataset, method: Method) -> None:
    """A wall behind a nearer wall has no weight; without the nearer one it has."""
    assert data.region is not None
    centre = np.array(data.region.centre)
    towards = unit(centre - data.views[0].to_world[:3, 3])
    walls = [opaque((centre + d * towards)[None], -towards[None], None, [3.0]) for d in (3.0, 30.0, 0.5)]
    far = Surroundings(walls[0], EnvironmentLight.constant(0.5, 8))
    behind = map_directions(8) @ towards > 0.95
    for nearer, share in zip(walls[1:], (1.0, 0.0), strict=True):
        assert np.all(PhotographedLight.of(nearer, far, data.region, data.views, 8).weight[behind] == share)


def test_table_that_is_not_finite_is_cleaned(data: Dataset, method: Method) -> None:
    said: list[str] = []
    trainer = Trainer(method, data, warn=said.append)
    set_rows(trainer.fit.tables[1], "opacity", [3, 5], np.nan)
    step_to(trainer, 2).check()
    assert trainer.fit.tables[1].surfels.count == 58 and trainer.surfels.count == 80
    assert "surroundings/opacity" in said[0]


CHOSEN = (None, "photographs", "auto"), ("relighting", "photographs_relighting", "relighting")


@pytest.mark.parametrize(("purpose", "own", "alpha"), [*CHOSEN, ("photographs",) * 3])
def test_images_without_alpha_have_a_method_of_their_own(
    data: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, purpose: str | None, own: str, alpha: str
) -> None:
    """It is chosen from one reading, without decoding an image, and fits a background."""
    said: list[str] = []
    monkeypatch.setattr(ImageFile, "decode", lambda _: pytest.fail("an image was decoded"))
    read = Mock(wraps=READERS.values)
    monkeypatch.setattr(READERS, "values", read)
    method, views = chosen(data.path, Choice(purpose=purpose), said.append)
    assert method.name == own and any(own in text for text in said) == (own != purpose)
    large = [replace(view, width=400, height=300) for view in views.views]
    for seen, linear in ((views.views, False), (large, True)):
        groups = FitSetup(method, replace(views, views=tuple(seen))).groups({})
        assert {group.linear for group in groups.values()} == {linear}
    by_row = groups["radiance_sh"].by_row
    assert (by_row is of_diffuse_colour) == method.rates.diffuse_relative == (own == "photographs")
    assert read.call_count == 1 and views.split == "train"
    monkeypatch.undo()
    assert chosen(write_data(tmp_path, views=3, truth=False), Choice(purpose=purpose))[0].name == alpha
    assert method.surroundings is not None and "photograph_light" in method.event
