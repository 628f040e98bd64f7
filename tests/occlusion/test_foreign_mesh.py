"""Meshes made elsewhere, of few triangles and of any size, as occluders."""

from functools import partial
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.occlusion.mesh import Mesh, read_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.reflectance.split_sum import MATERIALS
from mi_refgs.surfels.table import Surfels
from tests.helpers import refused, unit, vector
from tests.scenes.splats import discs

SCALES = [1.0, 1e-6, 1e6]
UP = np.array([0.0, 0, 1])


def sheet(height: float, scale: float) -> trimesh.Trimesh:
    """A horizontal square of side 2 of two triangles."""
    corners = np.array([[-1, -1, height], [1, -1, height], [1, 1, height], [-1, 1, height]])
    return trimesh.Trimesh(scale * corners, [[0, 1, 2], [0, 2, 3]], process=False)


def occluder(folder: Path, mesh: Any) -> Occluder:
    (folder / "elsewhere.ply").write_bytes(mesh.export(file_type="ply"))
    return Occluder(read_mesh(folder / "elsewhere.ply"))


def points(rng: np.random.Generator, height: float, scale: float) -> "mi.Point3f":
    place = np.append(rng.uniform(-0.4, 0.4, (200, 2)), np.full((200, 1), height), axis=1)
    return mi.Point3f((scale * place).T.astype(np.float32))


@pytest.mark.parametrize("scale", SCALES)
def test_two_plates_occlude_each_other(tmp_path: Path, scale: float, rng: np.random.Generator) -> None:
    """Half a unit apart, seen between them and from outside."""
    both = occluder(tmp_path, trimesh.util.concatenate([sheet(0, scale), sheet(0.5, scale)]))
    slanted = vector(UP + 0.3 * rng.normal(size=(200, 3)) * (1, 1, 0))
    up, down = mi.Vector3f(0, 0, 1), mi.Vector3f(0, 0, -1)
    assert not np.any(both.visible(points(rng, 0, scale), slanted, up))
    assert not np.any(both.visible(points(rng, 0.5, scale), -slanted, down))
    assert np.all(both.visible(points(rng, 0.5, scale), slanted, up))
    assert np.all(both.visible(points(rng, 0, scale), -slanted, down))


@pytest.mark.parametrize("scale", SCALES)
def test_a_sheet_hides_nothing_from_its_own_points(tmp_path: Path, scale: float, rng: Any) -> None:
    """From either side, and grazing it by 0.006°; from behind it hides what is in front."""
    alone = occluder(tmp_path, sheet(0, scale))
    for side in (UP, -UP):
        normal = vector(np.tile(side, (200, 1)))
        for lift in (1.0, 1e-2, 1e-4):
            along = unit(np.append(rng.normal(size=(200, 2)), np.zeros((200, 1)), axis=1)) + lift * side
            assert np.all(alone.visible(points(rng, 0, scale), vector(along), normal)), (side, lift)
        assert not np.any(alone.visible(points(rng, -0.3 * side[2], scale), normal, normal))


@pytest.mark.parametrize("scale", SCALES)
def test_vertices_keep_their_normals_and_materials_at_any_scale(tmp_path: Path, scale: float) -> None:
    ball = trimesh.creation.icosphere(2, 1.0)
    made = occluder(tmp_path, trimesh.Trimesh(scale * ball.vertices, ball.faces, process=False))
    # Surfels that lie flat on the ball do not agree with its normals: the mesh's own must serve.
    count = len(ball.vertices)
    size, flat = np.full((count, 2), np.log(0.1 * scale)), np.tile([1.0, 0, 0, 0], (count, 1))
    colours = {"albedo": np.zeros((count, 3)), "metallic": np.zeros((count, 1))}
    colours["roughness"] = np.linspace(-2, 2, count)[:, None]
    surfels = Surfels.from_numpy(discs(position=scale * ball.vertices, rotation=flat, scale=size, **colours))
    made.set_materials(surfels)
    rows = np.array(made.surface(surfels, MATERIALS).rows).reshape(count, 8)
    # No vertex has the materials of a surfel that is not usable.
    broken = surfels.to_numpy()
    broken["position"][7] = np.nan
    made.set_materials(Surfels.from_numpy(broken))
    assert made.vertex_surfels is not None and 7 not in np.array(made.vertex_surfels.surfel)
    none = Surfels.from_numpy(broken | {"roughness": np.full((count, 1), np.inf)})
    refused(lambda: made.set_materials(none), "none has finite values")
    made.set_materials(surfels)
    sideways = np.abs(ball.vertices[:, 2]) < 0.4
    np.testing.assert_allclose(rows[sideways, 5:], ball.vertices[sideways], atol=0.03)
    np.testing.assert_allclose(rows[:, 4], surfels.value("roughness").numpy(), atol=0.04)


@pytest.mark.parametrize("noted", [True, False])
def test_a_mesh_without_faces_hides_nothing(tmp_path: Path, noted: bool) -> None:
    path = tmp_path / "empty.ply"
    comment = "comment voxel_size 0.25\n" if noted else ""
    path.write_text(
        f"ply\nformat ascii 1.0\n{comment}element vertex 0\nproperty float x\nproperty float y\n"
        "property float z\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"
    )
    mesh = read_mesh(path)
    assert mesh.voxel == (0.25 if noted else 1)
    assert np.all(Occluder(mesh).visible(mi.Point3f(0), mi.Vector3f(0, 0, 1)))
    for corners, voxel, what in (
        (np.eye(3), 0, "not above 0"),
        (np.eye(2, 3), 1, "vertex that is not there"),
    ):
        refused(partial(Mesh, corners, np.array([[0, 1, 2]]), voxel), what)
