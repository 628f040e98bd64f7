"""Evaluation: numbers of the exported scene, reasons of missing ones, contact sheets, names of images."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest
from skimage.transform import resize_local_mean

from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.evaluation import images, metrics
from mi_refgs.evaluation.evaluate import evaluate, render_names
from mi_refgs.fitting.train import Trainer
from mi_refgs.io.images import read_png, write_png
from mi_refgs.kernels.device import upload_tensor
from mi_refgs.methods import load_resolved
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import render
from mi_refgs.runs.run import CAMERAS, EXPOSURE, Run
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.runs.views import measured_views, read_views
from mi_refgs.surfels.ply import write_ply
from tests.scenes.open_pair import CASES, Pair
from tests.scenes.tiny import SIZE, write_data, write_method, write_open_data

KEYS = (
    "psnr psnr_aligned aligned_reason psnr_object ssim lpips lpips_reason "
    "normal_mae_deg normal_mae_deg_full normal_reason "
    "albedo_psnr albedo_scale albedo_reason roughness_mae roughness_reason metallic_mae metallic_reason "
    "surface_distance surface_accuracy surface_completeness surface_reason concave_share concave_reason "
    "psnr_concave normal_mae_deg_concave albedo_psnr_concave surface_distance_concave "
    "env_scale env_mae env_psnr env_correlation env_reason "
    "train_seconds iterations surfels ms_per_frame method preset caption dataset machine image_size downscale"
).split()


@pytest.fixture
def run(run: Path) -> Run:
    """A copy of the run, which was not exported."""
    for file in ("model.json", "surfels.ply"):
        (run / file).unlink()
    return Run(run)


@pytest.fixture
def views(data: Path) -> Dataset:
    return read_dataset(data, "test")


@pytest.fixture
def trainer(run: Run, data: Path) -> Trainer:
    """The state at the end of the fit."""
    return Trainer(run.method(), read_dataset(data, "train"), run)


def test_trainer_metrics(run: Run, trainer: Trainer, views: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    """Exported, read back and measured: every metric, view by view, of frames with AOVs and timed without."""
    rendered = Mock(wraps=render)
    with monkeypatch.context() as patch:
        patch.setattr("mi_refgs.runs.trained_scene.render", rendered)
        result = evaluate(run)
    asked = [bool(call.kwargs["request"].aovs) for call in rendered.call_args_list]
    assert asked == [True] * 4 + [False] * (metrics.WARM_UP_FRAMES + metrics.TIMED_FRAMES)
    assert result["antialias"] and not trainer.shading().antialias
    scores = []
    for view in (view.load() for view in views.views):
        planes = displayed(trainer.view(view.camera()), views.background, views.is_linear_radiance)
        scores.append(metrics.psnr(images.image_array(planes, SIZE, SIZE), view.image))
    assert result["psnr"] == pytest.approx(np.mean(scores), abs=1e-4)
    assert [view["psnr"] for view in result["views"]] == pytest.approx(scores, abs=1e-4)
    sheet = read_png(run.path / "contact_sheet.png")
    assert sheet.shape[0] > 2 * images.CELL_MIN and sheet.shape[1] > 6 * images.CELL_MIN
    names = sorted(path.name for path in (run.path / "eval").iterdir())
    assert names == ["000_test_r_0.png", "001_test_r_1.png"]
    assert result.keys() >= set(KEYS)
    written = json.loads((run.path / "metrics.json").read_text())
    assert written == json.loads(json.dumps(result, allow_nan=False))
    assert result["iterations"] == 6 and result["method"] == "tiny" and result["preset"] == "quick"
    assert 0 < result["ms_per_frame"] and result["train_seconds"] > 0
    assert 0 <= result["normal_mae_deg_full"] < result["normal_mae_deg"] <= 180
    for key in ("lpips", "normal", "env", "albedo", "roughness", "metallic", "surface", "concave"):
        names = [name for name in result if name.startswith(key) and not name.endswith(("reason", "concave"))]
        assert any(result[name] is None for name in names) == bool(result[f"{key}_reason"]), key


def test_one_half_of_a_view_is_aligned_and_the_other_scored(run: Run, data: Path, tmp_path: Path) -> None:
    """Where the fit corrected cameras or exposure. What is darker in the scored half changes no gain."""
    plain = evaluate(run)
    assert plain["psnr_aligned"] is None and "corrected neither" in plain["aligned_reason"]
    run.write_json(EXPOSURE, {"gain": {}})
    with_gains = evaluate(run)
    (run.path / EXPOSURE).unlink()
    run.write_json(CAMERAS, {"to_world": {}})
    whole = evaluate(run)
    assert with_gains["psnr_aligned"] == whole["psnr_aligned"]
    assert whole["psnr"] == pytest.approx(plain["psnr"], abs=1e-4) and whole["aligned_reason"] is None
    assert whole["psnr_aligned"] > whole["psnr"] + 0.5
    parts = [f"psnr_aligned{part}" for part in ("", "_object")]
    found, board = [whole["views"][0]], (np.indices((SIZE, SIZE)) // 2).sum(axis=0) % 2
    for half in (1, 0):
        copy = shutil.copytree(data, tmp_path / f"{half}")
        image = read_png(copy / "test/r_0.png")
        image[board == half, :3] *= 0.5
        write_png(copy / "test/r_0.png", image)
        found.append(evaluate(run, copy)["views"][0])
    assert found[1]["gain"] == found[0]["gain"] and max(found[2]["gain"]) < 0.8 * min(found[0]["gain"])
    assert all(found[1][key] < found[0][key] - 1 for key in parts)


def test_photographs_are_measured_at_one_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever size was fitted; cameras belong to it. Images with alpha have the fitted size."""
    monkeypatch.setattr("mi_refgs.runs.views.MEASURED", 16)
    method = load_resolved(write_method(tmp_path))
    methods = [replace(method, data=replace(method.data, downscale=factor)) for factor in (1, 2)]
    photographs, masked = write_open_data(tmp_path / "open"), write_data(tmp_path / "alpha")
    first, second = (measured_views(one, photographs).views[0].load() for one in methods)
    whole = read_views(method, photographs, "test").views[0].load()
    np.testing.assert_array_equal(first.image, second.image)
    np.testing.assert_allclose(first.image, resize_local_mean(whole.image, (16, 16)), atol=1e-5)
    pixels, own = (np.array(view.project(np.array([[0.1, 0.2, 0.3]]))[:2]) for view in (first, whole))
    np.testing.assert_allclose((pixels + 0.5) * SIZE / 16, own + 0.5)
    assert [measured_views(one, masked).views[0].width for one in methods] == [SIZE, SIZE // 2]


def test_evaluate_measures_the_scene_files(run: Run) -> None:
    """An edited PLY counts; a checkpoint that is newer than the artefacts replaces them."""
    before = evaluate(run)
    fitted = TrainedScene.read(run.path)
    opacity = fitted.surfels.to_numpy() | {"opacity": np.full((fitted.surfels.count, 1), -20.0)}
    write_ply(run.path / "surfels.ply", type(fitted.surfels).from_numpy(opacity))
    assert evaluate(run)["psnr"] < before["psnr"]
    note = json.loads((run.path / "model.json").read_text())
    (run.path / "model.json").write_text(json.dumps(note | {"iteration": 3}))
    assert evaluate(run)["psnr"] == pytest.approx(before["psnr"], abs=1e-6)


def test_scene_file_has_the_fitted_size(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where `evaluate` writes it, and measures photographs at another one."""
    monkeypatch.setattr("mi_refgs.runs.views.MEASURED", 16)
    assert evaluate(run, write_open_data(tmp_path / "open"))["image_size"] == [16, 16]
    assert f'name="width" value="{SIZE}"' in (run.path / "scene.xml").read_text()


def test_panels_show_every_map_next_to_the_ground_truth(trainer: Trainer, views: Dataset) -> None:
    view = views.views[0].load()
    panels = images.panels(images.RenderedView.of(trainer.view(view.camera()), views, view), view)
    pairs = ("image: fitted | ground truth", "normals: fitted | ground truth")
    names = [f"{name}: fitted" for name in ("albedo", "metallic", "roughness", "visibility")]
    assert list(panels) == [*pairs, *names]
    for title, picture in panels.items():
        assert picture.shape[0] == SIZE and (picture.shape[1] > 2 * SIZE) == ("|" in title), title
        assert 0 <= picture.min() and picture.max() <= 1, title
    np.testing.assert_array_equal(panels[pairs[0]][:, -SIZE:], view.displayed)
    assert np.all(panels[pairs[1]][0, -1] == 1)  # the corner shows no ball, hence white


def test_panels_of_open_scene_show_maps_of_object_only() -> None:
    """Where only the background is seen, normals, colours and numbers have that of the sheet."""
    pair = Pair(*CASES[0])
    eye, frame = pair.case.camera, pair.frame({name: upload_tensor(x) for name, x in pair.values.items()})
    black = np.zeros((eye.height, eye.width, 3), np.float32)
    view = View("a", eye.width, eye.height, 9, 9, 4, 4, np.eye(4), Pixels(black, None))
    data = Dataset(Path(), "test", (view,), np.ones(3, np.float32), False, None)
    panels = images.panels(images.RenderedView.of(frame, data, view), view)
    own, whole = (images.image_array(x, eye.height, eye.width) for x in (frame.object_alpha, frame.alpha))
    background = whole > own + 0.2
    assert background.any()
    for title in ("normals", "albedo", "metallic", "roughness"):
        beside = images.BESIDE_GREYS if title in ("metallic", "roughness") else np.ones(3)
        panel = panels[f"{title}: fitted"]
        assert np.all(panel[background] > beside * (1 - own[background, None]) - 1e-5), title
        assert panel.min() < 0.9, title


def test_render_names_are_unique_and_keep_letters() -> None:
    names = ["test/r_0", "左", "éA", "éa", "", "!", "x" * 300, "b c", "b/c"]
    found = render_names([SimpleNamespace(name=name) for name in names])  # type: ignore[misc]
    assert len({name.casefold() for name in found}) == len(names)
    assert found[:2] == ["eval/000_test_r_0.png", "eval/001_左.png"]
    assert all(len(name.encode()) < 255 and re.fullmatch(r"eval/[^./]+\.png", name) for name in found)
