"""Errors of materials and surface against ground truth, over all pixels and over concave ones."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.cli.evaluate import table
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.evaluation import surface
from mi_refgs.evaluation.decomposition import Decomposition
from mi_refgs.evaluation.evaluate import DECOMPOSITION, evaluate
from mi_refgs.evaluation.images import RenderedView
from mi_refgs.io.images import read_png
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference.camera import look_at
from mi_refgs.runs.export import export
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.surfels.attributes import SH_DC
from mi_refgs.surfels.table import Surfels
from tests.scenes.known import (
    CENTRES,
    CLAY,
    METAL,
    RADII,
    SIZE,
    known_mesh,
    known_surfels,
    write_known_run,
)

H = W = 8


@pytest.fixture
def data(known: Path) -> Path:
    """The data set of the two known balls."""
    return known / "data"


# ---------------- materials ----------------


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
    view = View(
        "a",
        W,
        H,
        9,
        9,
        4,
        4,
        np.eye(4),
        colour,
        alpha,
        normal,
        alpha,
        is_linear_radiance=False,
        materials=materials,
    )
    return RenderedView(colour, alpha, normal, {}), view, rng.random((H, W)) > 0.5


def maps_of(view: View, factor: Any = 1.0) -> dict[str, np.ndarray]:
    """The true materials as ours, albedo times a factor; 7 where they are unknown."""
    found = {}
    for name, values in view.materials.items():
        ours = values[..., :-1] * (factor if name == "albedo" else 1)
        found[name] = np.where(values[..., -1:] > 0, ours, 7)
        if ours.shape[-1] == 1:
            found[name] = found[name][..., 0]
    return found


def test_perfect_decomposition_has_no_error() -> None:
    """The scale of albedo per channel is reported and does not count; unknown materials do not either."""
    factor = np.array([2.0, 0.5, 1.25])
    errors = Decomposition()
    for seed in range(3):
        shot, view, concave = random_view(seed)
        errors.add(shot, maps_of(view, factor), view, concave)
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
    errors, ours, true, apart, rough = Decomposition(), [], [], [], []
    rng = np.random.default_rng(9)
    for seed in range(3):
        shot, view, concave = random_view(seed)
        maps = maps_of(view)
        maps["albedo"] = maps["albedo"] + rng.normal(0, 0.1, (H, W, 3))
        maps["roughness"] = maps["roughness"] + np.where(concave, 0.3, 0.1)
        errors.add(shot, maps, view, concave)
        assert view.alpha is not None
        counted = (view.alpha > 0.5) & (view.materials["albedo"][..., -1] > 0)
        ours.append(maps["albedo"][counted])
        true.append(view.materials["albedo"][counted][:, :3])
        apart.append(concave[counted])
        rough.append(np.where(concave, 0.3, 0.1)[counted])
    a, b, c = np.concatenate(ours), np.concatenate(true), np.concatenate(apart)
    scale = (a * b).sum(0) / (a * a).sum(0)
    found = errors.result()
    for suffix, where in (("", np.ones(len(a), bool)), ("_concave", c)):
        error = np.mean((scale * a - b)[where] ** 2)
        assert found[f"albedo_psnr{suffix}"] == pytest.approx(-10 * np.log10(error), abs=1e-3)
        expected = np.concatenate(rough)[where].mean()
        assert found[f"roughness_mae{suffix}"] == pytest.approx(expected, abs=1e-6)
    np.testing.assert_allclose(found["albedo_scale"], scale, rtol=1e-6)


def test_missing_materials_are_null_with_a_reason() -> None:
    shot, view, _ = random_view(0)
    errors = Decomposition()
    maps = maps_of(view)
    del maps["albedo"], view.materials["metallic"]
    errors.add(shot, maps, view, None)
    found = errors.result()
    assert found["albedo_psnr"] is None and "run has no albedo" in found["albedo_reason"]
    assert found["metallic_mae"] is None and "data set defines no metallic" in found["metallic_reason"]
    assert found["roughness_mae"] == 0 and found["roughness_reason"] is None
    assert found["concave_share"] is None and "surface.ply" in found["concave_reason"]
    assert found["albedo_scale"] is None and found["psnr_concave"] is None


# ---------------- surface ----------------


def mesh_of(shape: Any) -> Mesh:
    return Mesh(np.asarray(shape.vertices, np.float32), np.asarray(shape.faces, np.uint32), 1e-3)


def truth_of(*shapes: Any) -> surface.TrueSurface:
    mesh = mesh_of(trimesh.util.concatenate(shapes))
    return surface.TrueSurface(mesh, Occluder(mesh))


def around(count: int = 8) -> list[View]:
    """Cameras on a circle and above that look at the origin."""
    blank = np.zeros((16, 16, 3), np.float32)
    views = []
    for i in range(count):
        angle = 2 * np.pi * i / count
        origin = 6 * np.array([np.cos(angle), np.sin(angle), np.sin(3 * angle)])
        pose = look_at(origin, np.zeros(3))
        views.append(
            View(f"{i}", 16, 16, 16, 16, 8, 8, pose, blank, None, None, None, is_linear_radiance=False)
        )
    return views


def ball(radius: float, centre: tuple[float, ...] = (0, 0, 0)) -> Any:
    shape = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    return shape.apply_translation(centre)


def test_distance_to_itself_is_zero() -> None:
    truth = truth_of(ball(1))
    found = surface.surface_distance(truth.mesh, truth, around())
    assert found["surface_distance"] < 1e-3 and "surface_distance_concave" not in found


def test_distance_of_spheres() -> None:
    """In percent of the true diameter, either way."""
    found = surface.surface_distance(mesh_of(ball(1.1)), truth_of(ball(1)), around())
    for key in surface.SURFACE_KEYS:
        assert found[key] == pytest.approx(5, abs=0.05)


def test_distance_counts_missing_but_not_hidden_surface() -> None:
    """A second ball beside the first is missing; one inside it is hidden, on either side."""
    both = truth_of(ball(1), ball(0.5, (1.7, 0, 0)))
    found = surface.surface_distance(mesh_of(ball(1)), both, around())
    assert found["surface_accuracy"] < 0.02 and found["surface_completeness"] > 2
    inside = trimesh.util.concatenate([ball(1), ball(0.5)])
    for ours, true in ((ball(1), inside), (inside, ball(1))):
        found = surface.surface_distance(mesh_of(ours), truth_of(true), around())
        assert found["surface_distance"] < 1e-3


def test_closed_cavity_counts_as_concave_error() -> None:
    """A box with a pit against the same box without: all distance is in the pit."""
    box = trimesh.creation.box((2, 2, 1)).subdivide().subdivide()
    above = [
        replace(v, to_world=look_at(np.array([0.1 * i, 0.3, 6]), np.zeros(3)))
        for i, v in enumerate(around(3))
    ]
    found = surface.surface_distance(mesh_of(box), truth_of(pitted_box()), [*around(), *above])
    assert found["surface_distance_concave"] > 4 * found["surface_distance"] > 0
    assert found["surface_completeness_concave"] > 3


def pitted_box() -> Any:
    """The box of 2 × 2 × 1 whose top has a square pit, 1 wide and 0.6 deep, as an open surface."""
    box = trimesh.creation.box((2, 2, 1)).subdivide().subdivide()
    middle = box.triangles_center
    lid = (middle[:, 2] > 0.49) & (abs(middle[:, 0]) < 0.5) & (abs(middle[:, 1]) < 0.5)
    box.update_faces(~lid)
    pit = trimesh.creation.box((1, 1, 0.6)).subdivide()
    pit.apply_translation((0, 0, 0.2))
    pit.update_faces(pit.triangles_center[:, 2] < 0.49)
    return trimesh.util.concatenate([box, pit])


def test_ambient_visibility_inside_a_cap() -> None:
    """Everywhere inside a cap of a sphere it is 1 - h / 2R; on the outside 1."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    for height in (0.5, 1.0):
        cap = sphere.copy()
        cap.update_faces(cap.triangles_center[:, 2] < height - 1)
        occluder = Occluder(mesh_of(cap))
        down = np.array([[0, 0, -1], [0.3, 0, -0.95], [0.2, 0.2, -0.96]])
        point = down / np.linalg.norm(down, axis=1, keepdims=True)
        inside = surface.ambient_visibility(occluder, mi.Point3f(point.T * 0.999), mi.Vector3f(-point.T))
        np.testing.assert_allclose(inside.numpy(), 1 - height / 2, atol=0.04)
        outside = surface.ambient_visibility(occluder, mi.Point3f(point.T * 1.001), mi.Vector3f(point.T))
        np.testing.assert_array_equal(outside.numpy(), 1)


def test_concave_pixels_are_between_the_balls(data: Path) -> None:
    truth = surface.TrueSurface.read(data)
    assert truth is not None
    for view in (view.load() for view in read_dataset(data, "test").views):
        concave = truth.concave(view)
        assert concave is not None and view.depth is not None
        assert not concave[view.depth == 0].any() and 0.02 < concave[view.depth > 0].mean() < 0.4
        rays = np.array(view.camera().rays()).T.reshape(SIZE, SIZE, 3)
        point = view.to_world[:3, 3] + rays * view.depth[..., None]
        gap = np.abs(np.linalg.norm(point[..., None, :] - CENTRES, axis=-1) - RADII).max(axis=-1)
        hit = view.depth > 0
        assert gap[concave].mean() < 0.7 * gap[hit & ~concave].mean()
        assert truth.concave(replace(view, depth=None)) is None


# ---------------- runs ----------------


def test_evaluate_scores_a_perfect_run(data: Path, tmp_path: Path) -> None:
    run = write_known_run(data, tmp_path / "run")
    result = evaluate(run)
    assert result["albedo_psnr"] > 28 and result["roughness_mae"] < 0.005 and result["metallic_mae"] < 0.02
    np.testing.assert_allclose(result["albedo_scale"], 1, atol=0.02)
    assert result["surface_distance"] < 0.1 and result["surface_distance_concave"] < 0.1
    assert result["env_psnr"] > 60 and 0.05 < result["concave_share"] < 0.2
    assert result["psnr_concave"] < result["psnr"]  # neither shadows nor bounces
    text = table(result)
    assert "albedo, PSNR after scale" in text and "(concave: " in text
    assert json.loads((run.path / "metrics.json").read_text())["surface_reason"] is None
    sheet = read_png(run.path / DECOMPOSITION)
    assert sheet.shape[1] > 10 * SIZE and sheet.std() > 0.1


def test_evaluate_scores_a_wrong_run(data: Path, tmp_path: Path) -> None:
    """Materials of the other ball, and a surface that is 2 % too small."""
    run = write_known_run(data, tmp_path / "run")
    fitted = TrainedScene.read(run.path)
    raw = fitted.surfels.to_numpy()
    raw["metallic"], raw["roughness"] = -raw["metallic"], raw["roughness"] + 1
    assert fitted.mesh is not None
    mesh = replace(fitted.mesh, vertices=fitted.mesh.vertices * np.float32(0.98))
    wrong = replace(fitted, surfels=Surfels.from_numpy(raw), mesh=mesh)
    export(wrong, run.path, read_dataset(data, "test").views[0].camera())
    result = evaluate(run)
    assert result["metallic_mae"] > 0.95 and result["roughness_mae"] > 0.15
    assert 0.3 < result["surface_distance"] < 2


def test_evaluate_without_ground_truth_gives_reasons(data: Path, tmp_path: Path) -> None:
    """Every key stays; the maps and the surface of the data set are gone here."""
    run = write_known_run(data, tmp_path / "run", occlusion=False)
    bare = tmp_path / "bare"
    (bare / "test").mkdir(parents=True)
    content = json.loads((data / "transforms_test.json").read_text())
    for i, frame in enumerate(content["frames"]):
        (bare / "test" / f"{i}.png").write_bytes((data / f"{frame['file_path']}.png").read_bytes())
    frames = [
        {"file_path": f"test/{i}", "transform_matrix": frame["transform_matrix"]}
        for i, frame in enumerate(content["frames"])
    ]
    (bare / "transforms_test.json").write_text(json.dumps(content | {"frames": frames}))
    (bare / "transforms_train.json").write_text(json.dumps(content | {"frames": frames}))
    result = evaluate(run, bare)
    for name, key in (
        ("albedo", "albedo_psnr"),
        ("surface", "surface_distance"),
        ("concave", "concave_share"),
    ):
        assert result[key] is None and result[f"{name}_reason"]
    assert result["surface_reason"] == "the run has no mesh"


# ---------------- from a fitted colour to an albedo ----------------


@pytest.mark.parametrize("with_mesh", [False, True])
def test_relightable_recovers_albedo_from_fitted_radiance(data: Path, with_mesh: bool) -> None:
    """A radiance that changes with direction, (1 - S) albedo × irradiance on average over the hemisphere."""
    mesh = known_mesh()
    surfels = known_surfels()
    light = EnvironmentLight.from_file(data / "environment.exr")
    normal = surfels.primitive.normal(surfels)
    irradiance = light.prefilter().irradiance(normal).numpy().T
    raw = surfels.to_numpy()
    clay = raw["metallic"][:, 0] < 0
    truth = np.where(clay[:, None], CLAY["albedo"], METAL["albedo"])
    slope = np.random.default_rng(0).normal(0, 0.03, (len(truth), 3, 3))  # of each colour along x, y, z
    # A linear function has two thirds of its largest value as its cosine-weighted mean.
    mean = -np.einsum("ncx,nx->nc", slope, normal.numpy().T) * 2 / 3
    constant = (0.96 * irradiance * truth - mean - 0.5) / SH_DC
    linear = -slope[:, :, [1, 2, 0]] * [1, -1, 1] / np.sqrt(3 / (4 * np.pi))
    raw["radiance_sh"] = np.concatenate([constant, linear.transpose(0, 2, 1).reshape(-1, 9)], 1).astype("f4")
    wrong = raw | {
        "albedo": np.zeros_like(raw["albedo"]),
        "indirect_sh": np.zeros((len(truth), 3), np.float32),
    }
    scene = TrainedScene(
        Surfels.from_numpy(wrong), light, mesh if with_mesh else None, Shading(occlusion=with_mesh), 1, 0.0
    )
    found = relightable(scene)
    assert set(found.surfels.raw) == set(raw) - {"radiance_sh"}
    assert found.shading.diffuse == "irradiance" and found.light is light
    assert (found.shading.ambient_rays > 0) == with_mesh
    albedo = np.array(found.surfels.value("albedo")).T
    far = np.abs(np.array(surfels.position()).T[:, 0]) > 0.45  # from the other ball, which shades and shines
    np.testing.assert_allclose(albedo[clay & far], truth[clay & far], atol=0.04)
    np.testing.assert_allclose(albedo[~clay], 0.5, atol=0.01)  # a metal's is the channel


def test_relightable_requires_materials_and_light() -> None:
    surfels = known_surfels()
    raw = {name: x for name, x in surfels.raw.items() if name != "metallic"}
    light = EnvironmentLight.constant(0.5, 8)
    for scene, words in (
        (TrainedScene(surfels, None, None, Shading("surfel", "radiance"), 1, 0.0), "light: the run has none"),
        (TrainedScene(Surfels(raw), light, None, Shading("surfel", "radiance"), 1, 0.0), "metallic: the run"),
    ):
        with pytest.raises(InputError, match=words):
            relightable(scene)


def test_relightable_keeps_fitted_materials(data: Path) -> None:
    mesh = known_mesh()
    surfels = known_surfels()
    light = EnvironmentLight.constant(0.5, 8)
    scene = TrainedScene(surfels, light, mesh, Shading(diffuse="irradiance", occlusion=True), 1, 0.0)
    found = relightable(scene)
    for name in ("albedo", "metallic", "roughness", "position"):
        assert dr.all(found.surfels.raw[name].array == surfels.raw[name].array)
