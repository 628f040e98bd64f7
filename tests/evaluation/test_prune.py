"""Pruning removes what images do not need and nothing else, and the run can be restored."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.cli import main
from mi_refgs.constants import PRUNE_LIMIT
from mi_refgs.data.dataset import Dataset, read_dataset
from mi_refgs.evaluation.prune import prune
from mi_refgs.io.ownership import RECORD
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.trained_scene import Pruned, TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import sh_columns
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused
from tests.scenes.tiny import write_data

RADIANCE = Shading("surfel", "radiance", "sh")
MIRROR = Shading("pixel", "split_sum", "irradiance", occlusion=True)
DEGREE = 2
HIDDEN, CLEAR, BEHIND = 5, 4, 3
"""Useless surfels: inside the opaque ones, with an opacity below 1/255, and behind every camera."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_data(tmp_path_factory.mktemp("prune") / "ball")


@pytest.fixture(scope="module")
def train(folder: Path) -> Dataset:
    return read_dataset(folder, "train")


def needed(data: Dataset, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Raw attributes of visible opaque surfels, 3 × 3 of them in front of each camera."""
    grid = [(x, y) for x in (-0.2, 0, 0.2) for y in (-0.2, 0, 0.2)]
    position, rotation = [], []
    for view in data.views:
        right, up, forward = view.to_world[:3, :3].T
        normal = -forward
        turn = np.array([-normal[1], normal[0], 0, 1 + normal[2]])  # from z to the normal
        position += [0.3 * normal + x * right + y * up for x, y in grid]
        rotation += [turn / np.linalg.norm(turn)] * len(grid)
    count, columns = len(position), sh_columns(DEGREE)
    return {
        "position": np.array(position),
        "rotation": np.array(rotation),
        "scale": np.full((count, 2), np.log(0.12)),
        "opacity": np.full((count, 1), 8.0),
        "radiance_sh": np.pad(rng.uniform(-1, 1, (count, 3)), ((0, 0), (0, columns - 3))),
        "albedo": rng.normal(size=(count, 3)),
        "metallic": np.full((count, 1), 3.0),
        "roughness": np.full((count, 1), -3.0),
        "indirect_sh": np.zeros((count, columns)),
    }


def with_useless(raw: dict[str, np.ndarray], rng: np.random.Generator) -> Surfels:
    """The same surfels with useless ones before, between and after them."""
    extra = HIDDEN + CLEAR + BEHIND
    rows = {name: np.repeat(values[:1], extra, axis=0) for name, values in raw.items()}
    rows["position"] = rng.uniform(-0.02, 0.02, (extra, 3))
    rows["scale"][:HIDDEN] = np.log(0.01)
    rows["position"][HIDDEN : HIDDEN + CLEAR, 2] += 0.4
    rows["opacity"][HIDDEN : HIDDEN + CLEAR] = -6.0
    rows["position"][-BEHIND:, 2] += 50
    place = np.linspace(0, len(raw["position"]), extra).astype(int)
    return Surfels.from_numpy({name: np.insert(raw[name], place, rows[name], axis=0) for name in raw})


def scene(surfels: Surfels, shading: Shading, **more: Any) -> TrainedScene:
    light = EnvironmentLight.from_radiance(np.linspace(0.1, 2, 8 * 16 * 3).reshape(8, 16, 3))
    return TrainedScene(surfels, light, walls(-1, 2), shading, 7, 1.5, **more)


def walls(*heights: float, size: float = 20.0) -> Mesh:
    """Horizontal triangles."""
    corners = [[x * size, y * size, z] for z in heights for x, y in ((-1, -1), (1, -1), (0, 2))]
    faces = np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)
    return Mesh(np.array(corners, np.float32), faces, 0.01)


# ---------------- what is removed ----------------


def test_prune_removes_exactly_the_useless_surfels(
    train: Dataset, folder: Path, rng: np.random.Generator
) -> None:
    raw = needed(train, rng)
    whole = scene(with_useless(raw, rng), RADIANCE)
    pruned, report = prune(whole, train, read_dataset(folder, "test"))
    for name, values in pruned.surfels.to_numpy().items():
        np.testing.assert_array_equal(values, raw[name][:, : values.shape[1]].astype(np.float32), name)
    widths = {name: int(values.shape[1]) for name, values in pruned.surfels.raw.items()}
    assert widths == {"position": 3, "rotation": 4, "scale": 2, "opacity": 1, "radiance_sh": 3}
    assert pruned.light is None and pruned.mesh is None and pruned.shading == RADIANCE
    assert report["before"]["surfels"] - report["after"]["surfels"] == HIDDEN + CLEAR + BEHIND
    assert report["after"]["channels"] == widths
    assert report["before"]["ply_bytes"] > 3 * report["after"]["ply_bytes"]
    for split, count in (("train", 3), ("test", 2)):
        found = report[split]
        assert found["views"] == count and found["mean"] >= found["worst"] >= PRUNE_LIMIT
    assert pruned.pruned == Pruned(whole.surfels.count, PRUNE_LIMIT, report["train"]["worst"])
    assert json.loads(json.dumps(report, allow_nan=False)) == report


def test_prune_keeps_the_visible_sh_degree(train: Dataset, rng: np.random.Generator) -> None:
    raw = needed(train, rng)
    raw["radiance_sh"][:, 3:12] = rng.normal(size=(len(raw["position"]), 9))
    pruned, _ = prune(scene(Surfels.from_numpy(raw), RADIANCE), train)
    assert pruned.surfels.sh_degree("radiance_sh") == 1


@pytest.mark.parametrize("met", [False, True])
def test_prune_keeps_visible_tracing(met: bool, train: Dataset, rng: np.random.Generator) -> None:
    """Mirror rays from the floor hit the ceiling; a mesh that no ray hits is removed, with its attributes."""
    raw = needed(train, rng)
    raw["indirect_sh"][:, :3] = 5.0
    shading = replace(MIRROR, visibility_rays=2)
    mesh = walls(-1, 2) if met else walls(1000.0, size=0.1)
    pruned, _ = prune(replace(scene(Surfels.from_numpy(raw), shading), mesh=mesh), train)
    assert (pruned.mesh is not None) == pruned.shading.occlusion == met
    assert pruned.shading == (shading if met else replace(shading, occlusion=False, visibility_rays=1))
    assert pruned.surfels.has("indirect_sh") == met and not pruned.surfels.has("radiance_sh")
    assert pruned.light is not None and pruned.surfels.has("metallic")


def test_prune_keeps_everything_at_a_strict_limit(train: Dataset, rng: np.random.Generator) -> None:
    raw = needed(train, rng)
    raw["radiance_sh"][:, 12:] = rng.normal(size=(len(raw["position"]), 15))
    raw = {name: raw[name] for name in ("position", "rotation", "scale", "opacity", "radiance_sh")}
    whole = scene(Surfels.from_numpy(raw), RADIANCE)
    pruned, report = prune(whole, train, limit=99.0)
    for name, values in pruned.surfels.to_numpy().items():
        np.testing.assert_array_equal(values, whole.surfels.to_numpy()[name])
    assert report["trials"] and not any(trial["dropped"] for trial in report["trials"])
    assert report["train"]["worst"] == 100.0


def test_prune_keeps_alpha_that_the_background_hides(train: Dataset, rng: np.random.Generator) -> None:
    """White surfels in front of a white background stay: other backgrounds would show their absence."""
    raw = needed(train, rng)
    raw["radiance_sh"][:] = 0
    raw["radiance_sh"][:, :3] = 0.5 / 0.28209479
    pruned, _ = prune(scene(Surfels.from_numpy(raw), RADIANCE), train)
    assert pruned.surfels.count == len(raw["position"])


def test_prune_accepts_empty_and_invisible_scenes(train: Dataset, rng: np.random.Generator) -> None:
    raw = needed(train, rng)
    for count in (0, 4):
        rows = {name: values[:count] for name, values in raw.items()}
        rows["opacity"] = np.full((count, 1), -20.0)
        pruned, _ = prune(scene(Surfels.from_numpy(rows), RADIANCE), train)
        assert pruned.surfels.count == min(count, 1)


@pytest.mark.parametrize("limit", [0.0, -1.0, 101.0, float("nan"), float("inf")])
def test_prune_limit_out_of_range_is_refused(limit: float, train: Dataset, rng: np.random.Generator) -> None:
    whole = scene(Surfels.from_numpy(needed(train, rng)), RADIANCE)
    refused(lambda: prune(whole, train, limit=limit), "--limit: ", " dB is out of range; give")


# ---------------- the command ----------------


def test_pruned_run_reports_and_is_restored(
    finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    assert main(["export", str(run), "--prune", "--limit", "25", "--json"]) == 0
    said = capsys.readouterr()
    report = json.loads(said.out)["pruned"]
    whole, pruned = report["before"], report["after"]
    assert "dB, dropped" in said.err
    assert 0 < pruned["surfels"] < whole["surfels"]
    assert (run / "surfels.ply").stat().st_size == pruned["ply_bytes"] < whole["ply_bytes"]
    assert min(whole["ms_per_frame"], pruned["ms_per_frame"]) > 0
    assert "pruned: had" in (run / "scene.xml").read_text()
    changed = {path.name for path, data in before.items() if not path.is_file() or path.read_bytes() != data}
    assert changed <= {"surfels.ply", "mesh.ply", "scene.xml", "model.json"}

    assert main(["eval", str(run), "--json"]) == 0
    metrics = json.loads(capsys.readouterr().out)
    assert metrics["surfels"] == pruned["surfels"]
    worst = report["train"]["worst"]
    assert metrics["pruned"] == {"surfels": whole["surfels"], "limit": 25.0, "psnr": worst}
    assert main(["eval", str(run)]) == 0
    assert f"from {whole['surfels']} surfels" in capsys.readouterr().out
    assert main(["render", str(run), "-o", str(tmp_path / "x.exr")]) == 0

    assert main(["export", str(run)]) == 0
    for path, content in before.items():
        if path.name not in ("metrics.json", "contact_sheet.png", RECORD):
            assert path.read_bytes() == content, path
    assert TrainedScene.read(run).pruned is None


@pytest.mark.parametrize("note", [7, {}, {"surfels": 5, "limit": 50, "psnr": float("nan")}])
def test_unreadable_prune_note_is_refused(note: object, finished: Path, tmp_path: Path) -> None:
    run = shutil.copytree(finished, tmp_path / "run")
    content = json.loads((run / "model.json").read_text())
    (run / "model.json").write_text(json.dumps(content | {"pruned": note}))
    remedy = "restore it, or write it again with `refgs export"
    refused(lambda: TrainedScene.read(run), "model.json: cannot be read", remedy)


def test_prune_without_checkpoints_is_refused_in_place(finished: Path, tmp_path: Path) -> None:
    """Without checkpoints the scene files cannot be restored: a pruned scene must go to another folder."""
    run = shutil.copytree(finished, tmp_path / "run")
    shutil.rmtree(run / "checkpoints")
    before = (run / "surfels.ply").read_bytes()
    for more in ([], ["-o", f"{run}/../run"]):
        refused(["export", run, "--prune", *more], "checkpoints: none, from which")
    assert main(["export", str(run), "--prune", "--limit", "25", "-o", str(tmp_path / "out")]) == 0
    assert (run / "surfels.ply").read_bytes() == before
    assert (tmp_path / "out" / "surfels.ply").stat().st_size < len(before)
