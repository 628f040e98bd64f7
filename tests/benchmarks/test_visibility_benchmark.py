"""The benchmark of visibility runs, and its numbers are ordered as they must be. No times are tested."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from benchmarks.common.errors import compare
from benchmarks.common.montecarlo import estimate
from benchmarks.common.report import where
from benchmarks.visibility import cases, page
from benchmarks.visibility.cases import SMALL, Rule
from benchmarks.visibility.setup import Setup
from tests.helpers import ROOT

BENCHMARK = "visibility"
Row = dict[str, Any]


def errors_of(result: dict[str, Any], scene: str, depth: str) -> dict[str, float]:
    """relMSE by rule."""
    return {row["method"]: row["relmse"] for row in where(result["rows"], scene=scene, depth=depth)}


# ---------- The small instance ----------


def test_reports_are_written(folder: Path, result: dict[str, Any]) -> None:
    page = (folder / "visibility.md").read_text()
    assert not re.search(r"\bnan\b|\binf\b|\bNone\b", page)
    (link,) = re.findall(r"\]\((images/visibility_\w+\.png)\)", page)
    assert (folder / link).stat().st_size > 10_000
    for row in result["tradeoffs"]:
        assert f"{row['scene']}, roughness {row['roughness']:g}" in page


@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_occlusion_beats_none_at_depth_2(result: dict[str, Any], scene: str) -> None:
    error = errors_of(result, scene, "direct")
    for rule in ("mirror ray", "4 rays", "64 rays"):
        assert error[rule] < 0.1 * error["no occlusion"]
    assert error["64 rays"] < min(error["4 rays"], error["mirror ray"])


@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_traced_light_beats_none_at_full_depth(result: dict[str, Any], scene: str) -> None:
    error = errors_of(result, scene, "full")
    for rule in ("mirror ray", "4 rays", "64 rays"):
        assert error[f"{rule}, 4 bounces"] < error[f"{rule}, 1 bounce"] < 0.85 * error[rule]
    for bounces in ("1 bounce", "4 bounces"):
        few, many = (error[f"{rays} rays, {bounces}"] for rays in (4, 64))
        assert many < few < error[f"mirror ray, {bounces}"]
    assert error["64 rays, 1 bounce"] < 0.5 * error["mirror ray"]
    assert error["64 rays, 4 bounces"] < 0.25 * error["mirror ray"]


@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_the_path_tracer_adds_light_with_depth(result: dict[str, Any], scene: str) -> None:
    """A rule's bias falls as the reference grows; one bounce stands for one reflection more."""
    bias = {
        row["depth"]: row["bias"] for row in where(result["rows"], scene=scene, method="64 rays, 1 bounce")
    }
    assert bias["direct"] > bias["bounce"] > bias["full"]
    assert abs(bias["bounce"]) < 0.15


@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_many_rays_converge_to_exact_visibility(result: dict[str, Any], scene: str) -> None:
    curve = {row["rays"]: row for row in where(result["curve"], scene=scene)}
    most = max(curve)
    distance = [curve[k]["visibility_rms"] for k in (1, 4, 64, most)]
    assert distance == sorted(distance, reverse=True)
    assert distance[-1] < 4 * curve[most]["visibility_floor"] and distance[-1] < 0.01
    assert abs(curve[most]["visibility_bias"]) < 2e-3
    assert curve[64]["to_limit"] < 0.2 * curve[4]["to_limit"]


def test_noise_is_below_compared_errors(result: dict[str, Any]) -> None:
    for row in where(result["rows"], depth="full"):
        assert not row["below_floor"]


@pytest.mark.parametrize("indirect", ["harmonics", "1 bounce", "4 bounces"])
@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_budgets_are_above_the_noise_and_add_up(result: dict[str, Any], scene: str, indirect: str) -> None:
    (row,) = where(result["budgets"], scene=scene, indirect=indirect)
    assert row["total"] > row["floor"]
    assert row["adds_up"]


@pytest.mark.parametrize("scene", ["bowl", "plates"])
def test_budget_decomposes_the_error_of_the_rule(result: dict[str, Any], scene: str) -> None:
    """Its reference differs from that of the rows by noise; the best SH beat no indirect light."""
    error = errors_of(result, scene, "full")
    total = {row["indirect"]: row["total"] for row in where(result["budgets"], scene=scene)}
    assert total["1 bounce"] == pytest.approx(error["mirror ray, 1 bounce"], rel=0.1)
    assert total["harmonics"] < 0.5 * error["mirror ray"]


# ---------- Its parts ----------


def test_bounces_approach_the_path_tracer_at_full_depth() -> None:
    """In a bowl, most of whose light comes by several reflections: the bias falls to less than 4 %."""
    settings = replace(SMALL, spp=64)
    setup = Setup(cases.make_scene("bowl", settings.detail), settings)
    setup.material(0.3)
    reference = estimate(setup.reference(12))
    found = [compare(setup.image(Rule(64, bounces)), reference) for bounces in (0, 1, 2, 4, 8)]
    bias, relmse = ([row[key] for row in found] for key in ("bias", "relmse"))
    assert bias == sorted(bias) and bias[0] < -0.3 and abs(bias[-1]) < 0.04
    assert relmse == sorted(relmse, reverse=True) and relmse[-1] < 0.15 * relmse[0]


def test_setting_is_chosen_on_other_scenes_within_budget() -> None:
    """`lucky` is best here, `steady` on the other scene, which decides; `dear` is over the budget."""
    here = {"mirror ray": (1.0, 10.0), "lucky": (0.1, 29.0), "steady": (0.2, 20.0), "dear": (0.01, 31.0)}
    there = {"mirror ray": 1.0, "lucky": 0.9, "steady": 0.3, "dear": 0.01, "untimed": 1e-3}
    fixed = {"roughness": 0.3, "depth": "full"}
    rows: list[Row] = [
        {"scene": "here", "method": name, "relmse": error, "ms": time, "frame_ms": time, **fixed}
        for name, (error, time) in here.items()
    ]
    rows += [
        {"scene": "there", "method": name, "relmse": error, "ms": 10.0, "frame_ms": None, **fixed}
        for name, error in there.items()
    ]
    rows.append(rows[0] | {"method": "untimed", "relmse": 0.0, "ms": None, "frame_ms": None})
    rows[4]["frame_ms"] = 10.0
    budgets: list[Row] = [
        {"scene": name, "roughness": 0.3, "indirect": "harmonics", "total": 0.4} for name in ("here", "there")
    ]
    budgets += [row | {"indirect": "1 bounce", "total": 9.0} for row in budgets]
    shading = page.tradeoffs(rows, budgets)[0]
    assert (shading["scene"], shading["time"], shading["method"]) == ("here", "ms", "steady")
    assert shading["gain"] == pytest.approx(2) and shading["price"] == pytest.approx(2)
    assert shading["best_gain"] == pytest.approx(4) and shading["mirror_relmse"] == 1


@pytest.mark.parametrize("name", ["bowl", "deep_bowl", "plates"])
def test_scenes_are_closed_and_face_outwards(name: str) -> None:
    mesh = cases.make_scene(name, 0).mesh
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=True)
    assert whole.is_watertight
    parts = whole.split()
    assert len(parts) == 2 and all(part.volume > 0 for part in parts)
    assert cKDTree(parts[0].vertices).query(parts[1].vertices)[0].min() > 0.02  # they do not touch
    assert np.abs(np.linalg.norm(mesh.vertex_normals, axis=1) - 1).max() < 1e-6


def test_mesh_file_is_scaled() -> None:
    concave = cases.make_scene(str(ROOT / "scenes" / "meshes" / "trefoil.ply"), 0)
    assert concave.name == "trefoil" and concave.mesh.volume > 0
    assert np.linalg.norm(concave.mesh.vertices, axis=1).max() == pytest.approx(1)
