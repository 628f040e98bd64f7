"""Depth fusion and extraction against shapes whose distance is known, and the float64 specification."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from mi_refgs.occlusion import mesh as meshes, tsdf
from mi_refgs.reference import occlusion as ref
from mi_refgs.reference.camera import look_at
from mi_refgs.splat.camera import Camera
from tests.helpers import refused

SIZE = 96
FOCAL = SIZE / (2 * np.tan(np.radians(20)))
BOX = (np.full(3, -1.25), np.full(3, 1.25))

SHAPES = {"sphere": ref.sphere((0, 0, 0), 1), "torus": ref.torus(0.8, 0.3)}


def ring_of_views(count: int) -> list[np.ndarray]:
    """Poses at Fibonacci points on a sphere."""
    i = np.arange(count) + 0.5
    z, phi = 1 - 2 * i / count, i * np.pi * (1 + 5**0.5)
    r = np.sqrt(1 - z * z)
    return [look_at(4.0 * d, np.zeros(3)) for d in np.stack([r * np.cos(phi), r * np.sin(phi), z], axis=1)]


def camera(pose: np.ndarray, size: int = SIZE) -> Camera:
    return Camera.from_pose(size, size, -FOCAL, -FOCAL, size / 2, size / 2, pose)


def fuse(depths: list[np.ndarray], poses: list[np.ndarray], resolution: int = 48) -> tsdf.TSDF:
    flat = [mi.Float(d.ravel().astype(np.float32)) for d in depths]
    alpha = [dr.select(d > 0, mi.Float(0.6), 0.4) for d in flat]
    flat = [dr.select(d > 0, d, 3.5) for d in flat]  # a faint veil is no surface, whatever its depth
    return tsdf.fuse(zip(flat, alpha, map(camera, poses), strict=True), BOX, resolution)


def as_trimesh(mesh: meshes.Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.vertices.astype(np.float64), mesh.faces, process=False)


@pytest.mark.parametrize("name", SHAPES)
def test_surface_is_closed_outward_and_within_a_voxel(name: str) -> None:
    """Both directions of the Hausdorff distance, so that neither extra nor missing surface passes."""
    shape = SHAPES[name]
    poses = ring_of_views(12)
    mesh = meshes.extract_mesh(fuse([ref.depth_map(shape, p, FOCAL, SIZE) for p in poses], poses))
    error = np.abs(shape(mesh.vertices.astype(np.float64))) / mesh.voxel
    solid = as_trimesh(mesh)
    assert error.max() < 1 and np.sqrt(np.mean(error**2)) < 0.2, (error.max(), np.sqrt(np.mean(error**2)))
    assert solid.is_watertight and solid.is_winding_consistent and solid.area_faces.min() > 0
    assert len(np.unique(mesh.faces)) == len(mesh.vertices)
    assert solid.euler_number == (2 if name == "sphere" else 0)
    volume = {"sphere": 4 / 3 * np.pi, "torus": 2 * np.pi**2 * 0.8 * 0.3**2}[name]
    assert abs(solid.volume / volume - 1) < 0.03
    points = np.random.default_rng(1).uniform(-1.2, 1.2, (4000, 3))
    for _ in range(4):
        points -= shape(points)[:, None] * ref.normal(shape, points)
    away, _ = cKDTree(mesh.vertices).query(points)
    assert away.max() < 1.5 * mesh.voxel  # the nearest vertex, not the nearest point: up to ½ face more


def test_matches_the_float64_specification() -> None:
    """Two objects, one hiding the other, a view with a hole in it, and one that sees only part of the box."""
    shape = ref.union(ref.sphere((0.2, 0, 0.3), 0.6), ref.box((0, 0.1, -0.7), (0.9, 0.8, 0.15)))
    poses = ring_of_views(9)[1:]
    poses[3][:3, 3] += np.array([1.5, 0.5, 0])
    depths = [ref.depth_map(shape, p, FOCAL, SIZE) for p in poses]
    depths[2][40:50, 40:50] = 0
    fused = fuse(depths, poses, 40)
    index = np.random.default_rng(2).integers(0, fused.volume.shape, (2500, 3))
    points = fused.origin + fused.voxel * index
    cameras = [(pose, FOCAL, SIZE) for pose in poses]
    limits = fused.voxel, tsdf.TRUNCATION_VOXELS * fused.voxel, tsdf.UNSEEN_VOTE
    expected = np.array([ref.fuse_point(point, depths, cameras, *limits) for point in points])
    wrong = np.abs(fused.volume[tuple(index.T)] - expected) > 1e-4
    # Points within rounding of a texel border or of a threshold may fall on its other side.
    assert wrong.mean() < 0.003, wrong.mean()
    # The scene shows every kind of voxel.
    assert (expected == -1).any() and (expected == 1).any() and (np.abs(expected) < 0.9).any()


def test_one_leaking_view_drills_no_tunnel() -> None:
    """A hole in the alpha of one of 24 views would otherwise carve through the whole object."""
    poses = ring_of_views(24)
    depths = [ref.depth_map(SHAPES["sphere"], p, FOCAL, SIZE) for p in poses]
    depths[5][44:52, 44:52] = 0
    fused = fuse(depths, poses)
    corner = fused.origin + fused.voxel * np.moveaxis(np.indices(fused.volume.shape), 0, -1)
    assert (fused.volume[SHAPES["sphere"](corner) < -6 * fused.voxel] == -1).all()
    solid = as_trimesh(meshes.extract_mesh(fused))
    assert solid.is_watertight and solid.euler_number == 2
    assert abs(solid.volume / (4 / 3 * np.pi) - 1) < 0.03


def test_floaters_go_and_second_objects_stay() -> None:
    """A speck of 0.1 radius beside two balls; the wall of a cavity inside is no object either."""
    balls = ((-0.5, 0, 0), 0.5), ((0.7, 0, 0), 0.3), ((0, 0.9, 0.9), 0.1)
    shape = ref.union(*(ref.sphere(centre, radius) for centre, radius in balls))
    grid = np.stack(np.meshgrid(*[np.linspace(-1.2, 1.2, 61)] * 3, indexing="ij"), axis=-1)
    cavity = 0.3 - np.linalg.norm(grid - np.array([-0.5, 0, 0]), axis=-1)
    volume = np.clip(np.maximum(shape(grid), cavity) / 0.2, -1, 1).astype(np.float32)
    mesh = meshes.extract_mesh(tsdf.TSDF(volume, np.full(3, -1.2), 0.04))
    assert sorted(round(float(p.volume), 1) for p in as_trimesh(mesh).split()) == [0.1, 0.5]
    assert (shape(mesh.vertices) < 0.04).all() and mesh.vertices[:, 1].max() < 0.6


def test_objects_cut_by_the_box_get_a_lid() -> None:
    """A field that is inside everywhere still gives a closed box; exact zeros give no degenerate triangle."""
    mesh = meshes.extract_mesh(tsdf.TSDF(np.full((4, 5, 6), -1, np.float32), np.zeros(3), 0.5))
    assert as_trimesh(mesh).is_watertight
    assert len(meshes.extract_mesh(tsdf.TSDF(np.zeros((3, 3, 3), np.float32), np.zeros(3), 0.5)).faces) == 0
    volume = np.ones((5, 5, 5), np.float32)
    volume[2, 2, 2], volume[1, 2, 2] = -1, 0
    solid = as_trimesh(meshes.extract_mesh(tsdf.TSDF(volume, np.zeros(3), 0.5)))
    assert solid.is_watertight and solid.area_faces.min() > 0


def test_nothing_seen_is_an_empty_mesh() -> None:
    """All-background, NaN depth, and no views at all."""
    poses = ring_of_views(2)
    for value in (0.0, np.nan, np.inf):
        depth, alpha = (dr.full(mi.Float, x, SIZE * SIZE) for x in (value, 1.0 if value else 0.0))
        fused = tsdf.fuse([(depth, alpha, camera(p)) for p in poses], BOX, 16)
        assert np.isfinite(fused.volume).all()
        assert len(meshes.extract_mesh(fused).faces) == 0
    assert (tsdf.fuse([], BOX, 16).volume == 1).all()


def test_all_views_share_one_kernel() -> None:
    """Other poses, image sizes, boxes and views compile nothing; generators are read once."""
    poses = ring_of_views(7)

    def run(size: int, count: int, shift: float) -> None:
        image = dr.full(mi.Float, 4, size * size)
        views = ((image, image, camera(pose, size)) for pose in poses[:count])
        tsdf.fuse(views, (BOX[0] + shift, BOX[1] + shift), 24)

    run(32, 2, 0.0)
    before = dr.detail.launch_stats()
    run(40, 7, 0.1)
    after = dr.detail.launch_stats()
    assert after[1:] == (before[1], before[2]), "recompiled"
    assert after[0] - before[0] < 7 * 3 + 8


def test_bounds_ignore_floaters_but_keep_thin_ends() -> None:
    """1 % of points ten sizes away; a pole with 0.5 % of the points."""
    rng = np.random.default_rng(3)
    points = rng.uniform(-1, 1, (10000, 3))
    points[:100] = rng.normal(0, 10, (100, 3))
    points[100:150] = np.stack([np.zeros(50), np.zeros(50), rng.uniform(1, 1.3, 50)], axis=1)
    points[200] = np.nan
    lo, hi = tsdf.bounds_from_points(points)
    assert (lo < -1).all() and (hi > 1).all() and hi[2] > 1.3
    assert (hi - lo).max() < 4
    lo, hi = tsdf.bounds_from_points(np.array([[5.0, 5, 5]]))
    assert (hi.astype(np.float32) > lo.astype(np.float32)).all()
    refused(lambda: tsdf.bounds_from_points(np.full((4, 3), np.nan)), "position")


def test_a_resolution_that_does_not_fit_is_refused() -> None:
    refused(lambda: tsdf.fuse([], BOX, 4096), "resolution")


def test_a_part_of_a_mesh_has_whole_triangles_and_their_vertices_alone() -> None:
    vertices = np.arange(15, dtype=np.float32).reshape(5, 3)
    mesh = meshes.Mesh(vertices, np.array([[0, 1, 2], [4, 3, 1], [2, 1, 3]], np.uint32), 0.1)
    part = mesh.of_vertices(np.array([True, True, False, True, True]))
    np.testing.assert_array_equal(part.vertices, vertices[[1, 3, 4]])
    np.testing.assert_array_equal(part.faces, [[2, 1, 0]])


def test_mesh_file_round_trip(tmp_path: Path) -> None:
    """Vertices, faces, voxel, and the empty mesh; foreign files get a voxel from their edges."""
    solid = trimesh.creation.icosphere(2)
    mesh = meshes.Mesh(solid.vertices, solid.faces, 0.0123)  # of trimesh's types
    assert type(mesh.vertices) is np.ndarray and [mesh.vertices.dtype, mesh.faces.dtype] == ["f4", "u4"]
    for case in (mesh, meshes.Mesh.empty(0.5)):
        meshes.write_mesh(tmp_path / "mesh.ply", case)
        back = meshes.read_mesh(tmp_path / "mesh.ply")
        assert back.voxel == case.voxel
        np.testing.assert_array_equal(back.vertices, case.vertices)
        np.testing.assert_array_equal(back.faces, case.faces)
    assert [p.name for p in tmp_path.iterdir()] == ["mesh.ply"]
    meshes.write_mesh(tmp_path / "mesh.ply", mesh)
    loaded = mi.load_dict({"type": "ply", "filename": str(tmp_path / "mesh.ply")})
    assert loaded.face_count() == len(mesh.faces)
    solid.export(tmp_path / "foreign.obj")
    assert meshes.read_mesh(tmp_path / "foreign.obj").voxel == pytest.approx(12**0.5 / 256, rel=0.2)
    refused(lambda: meshes.read_mesh(tmp_path / "none.ply"), "no such file")
    (tmp_path / "bad.ply").write_text("hello")
    refused(lambda: meshes.read_mesh(tmp_path / "bad.ply"), "not a PLY file")
    refused(lambda: meshes.write_mesh(tmp_path / "bad.ply" / "mesh.ply", mesh), "cannot be created")
