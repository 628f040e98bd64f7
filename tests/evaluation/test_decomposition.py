"""Errors of materials and surface against ground truth, over all pixels and over concave ones."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.cli.evaluate import table
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.images import Pixels
from mi_refgs.data.view import View
from mi_refgs.evaluation.decomposition import Decomposition
from mi_refgs.evaluation.evaluate import SHEET, evaluate
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.io.images import read_png
from mi_refgs.runs.export import export
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.table import Surfels
from tests.scenes.known import SIZE, write_known_run

H = W = 8


def random_view(seed: int) -> tuple[RenderedView, View, np.ndarray]:
    """A view of noise: its render, its ground truth with partly known materials, and concave pixels."""
    rng = np.random.default_rng(seed)
    colour, normal = rng.random((H, W, 3)).astype(np.float32), rng.normal(size=(H, W, 3)).astype(np.float32)
    alpha = (rng.random((H, W)) > 0.3).astype(np.float32)
    known = (rng.random((H, W, 1)) > 0.2).astype(np.float32)
    materials = {
        name: np.concatenate([rng.uniform(0.2, 0.8, (H, W, c)) * known, known], -1).astype(np.float32)
        for name, c in (("albedo", 3), ("roughness", 1), ("metallic", 1))
    }
    size, given = (W, H, 9, 9, 4, 4, np.eye(4)), (Pixels(colour, alpha), normal, alpha)
    view = View("a", *size, *given, materials=materials)
    return RenderedView(colour, alpha, normal, {}), view, rng.random((H, W)) > 0.5


def maps_of(view: View, factor: Any = 1.0) -> dict[str, np.ndarray]:
    """The true materials as ours, albedo times a factor; 7 where they are unknown."""
    found = {}
    for name, values in view.materials.items():
        ours = values[..., :-1] * (factor if name == "albedo" else 1)
        ours = np.where(values[..., -1:] > 0, ours, 7)
        found[name] = ours if name == "albedo" else ours[..., 0]
    return found


def test_perfect_decomposition_has_no_error() -> None:
    """The scale of albedo per channel is reported and does not count; unknown materials do not either."""
    factor = np.array([2.0, 0.5, 1.25])
    errors = Decomposition()
    for seed in range(3):
        shot, view, concave = random_view(seed)
        errors.add(replace(shot, maps=maps_of(view, factor)), view, concave)
    found = errors.result()
    for suffix in ("", "_concave"):
        assert found[f"albedo_psnr{suffix}"] == pytest.approx(100, abs=1)
        assert found[f"roughness_mae{suffix}"] == 0 and found[f"metallic_mae{suffix}"] == 0
    assert found["normal_mae_deg_concave"] < 1e-3 and found["psnr_concave"] == 100
    np.testing.assert_allclose(found["albedo_scale"], 1 / factor, rtol=1e-6)
    assert 0.4 < found["concave_share"] < 0.6
    assert not any(found[f"{name}_reason"] for name in ("albedo", "roughness", "metallic", "concave"))


def test_errors_equal_plain_formulas() -> None:
    """Against the plain formulas over all foreground pixels of all views, and over the concave ones."""
    errors, pixels = Decomposition(), []
    rng = np.random.default_rng(9)
    for seed in range(3):
        shot, view, concave = random_view(seed)
        maps, rough = maps_of(view), np.where(concave, 0.3, 0.1)
        maps["albedo"] = maps["albedo"] + rng.normal(0, 0.1, (H, W, 3))
        maps["roughness"] = maps["roughness"] + rough
        errors.add(replace(shot, maps=maps), view, concave)
        assert view.alpha is not None
        true = view.materials["albedo"]
        counted = (view.alpha > 0.5) & (true[..., -1] > 0)
        pixels.append([x[counted] for x in (maps["albedo"], true[..., :3], concave, rough)])
    a, b, c, rough = (np.concatenate(parts) for parts in zip(*pixels, strict=True))
    scale = (a * b).sum(0) / (a * a).sum(0)
    found = errors.result()
    for suffix, where in (("", np.ones(len(a), bool)), ("_concave", c)):
        error = np.mean((scale * a - b)[where] ** 2)
        assert found[f"albedo_psnr{suffix}"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
        assert found[f"roughness_mae{suffix}"] == pytest.approx(rough[where].mean(), abs=1e-6)
    np.testing.assert_allclose(found["albedo_scale"], scale, rtol=1e-6)


def test_evaluate_scores_a_perfect_run(known: Path, tmp_path: Path) -> None:
    run = write_known_run(known / "data", tmp_path / "run")
    result = evaluate(run)
    assert result["albedo_psnr"] > 28 and result["roughness_mae"] < 0.005 and result["metallic_mae"] < 0.02
    np.testing.assert_allclose(result["albedo_scale"], 1, atol=0.02)
    assert result["surface_distance"] < 0.1 and result["surface_distance_concave"] < 0.1
    assert result["env_psnr"] > 60 and 0.05 < result["concave_share"] < 0.2
    assert result["psnr_concave"] < result["psnr"]  # neither shadows nor bounces
    text = table(result)
    assert "albedo, PSNR after scale" in text and "(concave: " in text
    assert text.startswith("scale: ") and "whole image of " in text
    assert json.loads((run.path / "metrics.json").read_text())["surface_reason"] is None
    # Two balls beside each other: no creases, and some of their mirror rays meet the other ball.
    budget = result["error_budget"]
    assert list(budget) == ["silhouette", "crease", "mirror_blocked", "mirror_free", "background"]
    for key in ("pixels", "squared_error"):
        assert sum(row[key] for row in budget.values()) == pytest.approx(1)
    assert budget["mirror_blocked"]["pixels"] < 0.3 * budget["mirror_free"]["pixels"]
    assert "smooth, mirror ray blocked" in text
    sheet = read_png(run.path / SHEET)
    assert sheet.shape[1] > 10 * SIZE and sheet.std() > 0.1


def test_evaluate_scores_a_wrong_run(known: Path, tmp_path: Path) -> None:
    """Materials of the other ball, and a surface that is 2 % too small."""
    run = write_known_run(known / "data", tmp_path / "run")
    fitted = TrainedScene.read(run.path)
    raw = fitted.surfels.to_numpy()
    raw["metallic"], raw["roughness"] = -raw["metallic"], raw["roughness"] + 1
    assert fitted.mesh is not None
    mesh = replace(fitted.mesh, vertices=fitted.mesh.vertices * np.float32(0.98))
    wrong = replace(fitted, surfels=Surfels.from_numpy(raw), mesh=mesh)
    export(wrong, run.path, read_dataset(known / "data", "test").views[0].camera())
    result = evaluate(run)
    assert result["metallic_mae"] > 0.95 and result["roughness_mae"] > 0.15
    assert 0.3 < result["surface_distance"] < 2


def test_evaluate_without_ground_truth_gives_reasons(known: Path, tmp_path: Path) -> None:
    """Every key stays; the maps and the surface of the data set are gone here."""
    data, bare = known / "data", tmp_path / "bare"
    run = write_known_run(data, tmp_path / "run", occlusion=False)
    (run.path / "mesh.ply").unlink()
    (bare / "test").mkdir(parents=True)
    content = json.loads((data / "transforms_test.json").read_text())
    frames = []
    for i, frame in enumerate(content["frames"]):
        shutil.copy(data / f"{frame['file_path']}.png", bare / "test" / f"{i}.png")
        frames.append({"file_path": f"test/{i}", "transform_matrix": frame["transform_matrix"]})
    for split in ("test", "train"):
        (bare / f"transforms_{split}.json").write_text(json.dumps(content | {"frames": frames}))
    result = evaluate(run, bare)
    assert result["dataset"] == str(bare)
    for key, reason in (
        ("albedo_psnr", "defines no albedo"),
        ("surface_distance", "the run has no mesh"),
        ("concave_share", "has no true surface"),
        ("normal_mae_deg", "no ground-truth normals"),
        ("env_psnr", "no environment.exr"),
    ):
        assert result[key] is None and reason in result[f"{key.partition('_')[0]}_reason"], key
    assert result["error_budget"] is None and "depth and normals" in result["error_budget_reason"]
    assert "error budget" not in table(result)
