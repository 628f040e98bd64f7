"""A PLY file as a relightable object: its views are images of the file, and are fitted as data sets are."""

import json
import shutil
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import mi_refgs
from mi_refgs import methods
from mi_refgs.cli import main
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.fitting.runner import Progress
from mi_refgs.fitting.train import Trainer
from mi_refgs.formats.orbits import shots_around
from mi_refgs.io.images import read_png, straight_srgb
from mi_refgs.methods.read import PRESETS
from mi_refgs.reconstruction import relightable_import
from tests.helpers import contents, refused
from tests.scenes import splat_file
from tests.scenes.layouts import ply_bytes
from tests.scenes.splat_file import PRESET, RADIUS, SIZE, VIEWS, ball_columns, write_ball
from tests.scenes.tiny import METHOD, write_method


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    splat_file.render_few_views(monkeypatch)


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ball(tmp_path_factory.mktemp("splats") / "ball.ply")


@pytest.fixture(scope="module")
def method(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny method for PRESET, which scales its stages to 6 iterations."""
    text = METHOD.replace("until = 3\n", "until = 1_000\n")
    text = text.replace("start = 3, until = 6", "start = 1_000, until = 2_000")
    return write_method(tmp_path_factory.mktemp("method"), text)


@pytest.fixture(scope="module")
def imported(ball: Path, method: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A relightable import; do not change it."""
    run = tmp_path_factory.mktemp("runs") / "run"
    with pytest.MonkeyPatch.context() as patch:
        splat_file.render_few_views(patch)
        mi_refgs.import_relightable(ball, run, method=method, preset=PRESET, progress=Progress())
    return run


def test_views_are_the_images_of_the_file(imported: Path, ball: Path) -> None:
    """Read as a data set: rendered by the file's formula from the stated cameras, with its alpha."""
    file = mi_refgs.import_splats(ball)
    for split, count in VIEWS.items():
        views = read_dataset(imported / "data", split).views
        assert len(views) == count and all(view.has_alpha for view in views)
        for view in views:
            goal = np.clip(straight_srgb(file.render(view)), 0, 1)
            found = read_png(imported / "data" / f"{view.name}.png")
            assert found.shape == (SIZE, SIZE, 4) and goal[..., 3].max() > 0.9 > 0.1 > goal[0, :, 3].mean()
            # Where alpha is small, the colour is that of few bits.
            assert np.abs((found - goal)[goal[..., 3] > 0.1]).max() < 3 / 255
            assert np.abs(found - goal)[..., 3].max() < 2 / 255


def test_cameras_are_all_around_and_test_views_are_others(imported: Path) -> None:
    train, test = (
        np.array([view.to_world[:3, 3] for view in read_dataset(imported / "data", split).views])
        for split in VIEWS
    )
    assert train[:, 2].min() < -RADIUS and train[:, 2].max() > RADIUS
    assert np.linalg.norm(train.mean(0)) < 0.3 * np.linalg.norm(train, axis=1).mean()
    assert min(np.linalg.norm(train - origin, axis=1).min() for origin in test) > 0.2
    assert 0 < test[0, 2] < 0.6 * np.linalg.norm(test[0])  # scene.xml has this camera


@pytest.mark.parametrize(("preset", "side"), [("quick", 282), ("paper", 800), ("6:9", 400)])
def test_preset_chooses_the_size_of_the_views(
    preset: str, side: int, ball: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stop = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(relightable_import, "PRESETS", PRESETS)
    monkeypatch.setattr(relightable_import, "_require_object", stop)
    with pytest.raises(KeyboardInterrupt):
        mi_refgs.import_relightable(ball, tmp_path / "run", preset=preset)
    sizes = {(shot.camera.width, shot.camera.height) for shot in stop.call_args.args[1]}
    assert sizes == {(side, side)} and not (tmp_path / "run").exists()


def test_given_cameras(ball: Path, method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every eighth is a test view; their sizes and lenses are theirs."""
    shots = shots_around(mi_refgs.import_splats(ball).trained.surfels, {"train": 10})
    poses = [shot.camera.pose() for shot in shots]
    frames = [{"transform_matrix": (pose @ MITSUBA_FROM_OPENGL).tolist()} for pose in poses]
    file, run = tmp_path / "cameras.json", tmp_path / "run"
    file.write_text(json.dumps({"w": 40, "h": 30, "fl_x": 30, "cx": 18, "frames": frames}))
    cameras = mi_refgs.formats.cameras.read_cameras(file)
    monkeypatch.setattr(relightable_import, "fit", lambda *given, **options: None)
    mi_refgs.import_relightable(ball, run, cameras=cameras, method=method, preset=PRESET, progress=Progress())
    train, test = (read_dataset(run / "data", split).views for split in ("train", "test"))
    assert (len(train), len(test)) == (8, 2)
    np.testing.assert_allclose([v.to_world for v in test], [poses[0], poses[8]], atol=1e-6)
    view = train[0]
    assert (view.width, view.height, view.fx, view.cx) == pytest.approx((40, 30, 30, 18))


def test_import_is_fitted_measured_and_relit(imported: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(imported, tmp_path / "run"))
    made = mi_refgs.load(run)
    assert made.trained.light is not None and made.trained.surfels.has("albedo")
    assert made.trained.iteration == 6 and made.provenance.data == (imported / "data").resolve()
    assert made.relight(np.ones((8, 16, 3), np.float32)).render(0)[..., 3].max() > 0.5
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["psnr"] > 5
    record = run / "dataset.json"
    record.write_text(record.read_text().replace(str(imported), "/gone"))  # under another name before
    assert mi_refgs.load(run).provenance.data == (run / "data").resolve()


def test_command_writes_the_same_views_and_fits_the_method_for_relighting(
    imported: Path, ball: Path, method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, for_purpose = tmp_path / "run", Mock(return_value=str(method))
    monkeypatch.setattr(methods, "for_purpose", for_purpose)
    assert main(["import", str(ball), "-o", str(run), "--relightable", "--preset", PRESET]) == 0
    assert contents(run / "data") == contents(imported / "data")
    for_purpose.assert_called_once_with("relighting")


def test_an_interrupted_import_is_an_interrupted_fit(
    ball: Path, method: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its message names the command that goes on."""
    monkeypatch.setattr(Trainer, "step", Mock(side_effect=KeyboardInterrupt))
    options: dict[str, Any] = {"method": method, "preset": PRESET, "progress": Progress()}
    run = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt, match=f"train {run / 'data'} -o {run} --resume"):
        mi_refgs.import_relightable(ball, run, **options)
    refused(lambda: mi_refgs.import_relightable(ball, run, **options), "contains a run already; ")


def test_scene_all_around_is_refused(ball: Path, tmp_path: Path) -> None:
    """A sky of one huge Gaussian; what is cropped to the object is imported."""
    sky = write_ball(tmp_path / "room.ply", **{f"scale_{i}": 4.0 for i in range(3)})
    argv = ["import", sky, "-o", tmp_path / "run", "--relightable", "--preset", PRESET]
    refused(argv, f"{sky}: surfels: views are opaque up to the border", "--box")
    columns, hidden = ball_columns(), tmp_path / "hidden.ply"
    hidden.write_bytes(ply_bytes(columns | {"opacity": columns["opacity"] - 13}))
    refused(["import", hidden, *argv[2:]], hidden, "views of the surfels show nothing")
    names = "refl_strength", "roughness", *(f"ori_color_{i}" for i in range(3))
    known = tmp_path / "known.ply"
    known.write_bytes(ply_bytes(columns | {name: np.zeros_like(columns["x"]) for name in names}))
    refused(["import", known, *argv[2:]], "it has materials already", "without --relightable")
    assert not (tmp_path / "run").exists()


def test_box_crops_an_import(ball: Path, tmp_path: Path) -> None:
    upper = [-1.0, -1.0, 0.0, 1.0, 1.0, 1.0]
    found = mi_refgs.import_splats(ball, box=upper).trained.surfels.to_numpy()["position"]
    assert (found[:, 2] >= 0).all() and len(found) == (ball_columns()["z"] >= 0).sum()
    assert main(["import", str(ball), "-o", str(tmp_path / "run"), "--box", *map(str, upper)]) == 0
    loaded = mi_refgs.load(tmp_path / "run").trained.surfels.to_numpy()["position"]
    np.testing.assert_array_equal(loaded, found)
    nowhere = ["import", ball, "-o", tmp_path / "none", "--box", 5, 5, 5, 6, 6, 6]
    refused(nowhere, f"{ball}: selection: none of the 300 surfels is in it")


def test_bad_preset_is_refused_before_views_are_rendered(ball: Path, tmp_path: Path) -> None:
    argv = ["import", ball, "-o", tmp_path / "run", "--relightable"]
    refused([*argv, "--preset", "fast"], "--preset: fast: unknown")
    refused([*argv, "--for", "fun"], "--for: fun: no method is for that")
    assert not (tmp_path / "run").exists()
