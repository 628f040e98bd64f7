"""Depth fusion of all of space, by contraction: against the float64 reference, and shapes near and far."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.data.region import Region
from mi_refgs.occlusion import tsdf
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.reference import occlusion as ref
from mi_refgs.reference.camera import look_at
from mi_refgs.render.surroundings import Surroundings
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels
from tests.occlusion.fusion_oracle import fused_points

SIZE = 80
FOCAL = SIZE / (2 * np.tan(np.radians(30)))
REGION = Region((0.1, -0.1, 0.2), 0.8)
BALL = np.array([0.1, 0.0, 0.15])
BALL_RADIUS, FLOOR = 0.35, -0.3
SPACE = (np.full(3, -2.0), np.full(3, 2.0))


def ring_of_views(count: int) -> list[np.ndarray]:
    angle = 2 * np.pi * np.arange(count) / count
    height = np.where(np.arange(count) % 2 == 0, 0.4, 1.5)
    where = np.stack([2 * np.cos(angle), 2 * np.sin(angle), height], axis=1)
    return [look_at(eye, BALL) for eye in where]


def ball_and_floor(to_world: np.ndarray) -> np.ndarray:
    """Depth (SIZE, SIZE) of a ball above an infinite floor; 0 where a ray meets neither."""
    j, i = np.mgrid[:SIZE, :SIZE] + 0.5
    local = np.stack([(SIZE / 2 - i) / FOCAL, (SIZE / 2 - j) / FOCAL, np.ones_like(i)], axis=-1)
    ray, eye = local @ to_world[:3, :3].T, to_world[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(ray[..., 2] < 0, (FLOOR - eye[2]) / ray[..., 2], np.inf)
        squared, half = np.sum(ray**2, axis=-1), ray @ (eye - BALL)
        root = np.sqrt(half**2 - squared * (np.sum((eye - BALL) ** 2) - BALL_RADIUS**2))
        ball = np.where(np.isfinite(root), (-half - root) / squared, np.inf)
    depth = np.minimum(floor, ball)
    return np.where(np.isfinite(depth), depth, 0)


def camera(pose: np.ndarray) -> Camera:
    return Camera.from_pose(SIZE, SIZE, -FOCAL, -FOCAL, SIZE / 2, SIZE / 2, pose)


def fuse(
    depths: list[np.ndarray], poses: list[np.ndarray], resolution: int, region: Region | None
) -> tsdf.TSDF:
    flat = [mi.Float(d.ravel().astype(np.float32)) for d in depths]
    alpha = [dr.select(d > 0, mi.Float(1), 0) for d in flat]
    return tsdf.fuse(flat, alpha, map(camera, poses), SPACE, resolution, carve=False, region=region)


@pytest.fixture(scope="module")
def ball_mesh() -> Mesh:
    mi.set_variant("llvm_ad_rgb")
    poses = ring_of_views(24)
    return extract_mesh(fuse([ball_and_floor(pose) for pose in poses], poses, 64, REGION))


def test_matches_the_float64_specification() -> None:
    poses = ring_of_views(7)
    depths = [ball_and_floor(pose) for pose in poses]
    depths[2][30:40, 30:40] = 0
    fused = fuse(depths, poses, 24, REGION)
    rng = np.random.default_rng(2)
    index = rng.integers(0, fused.volume.shape, (4000, 3))
    place = fused.origin + fused.voxel * index
    index = index[np.linalg.norm(place, axis=1) < fused.end]
    points = REGION.expand(fused.origin + fused.voxel * index)
    region = np.array(REGION.centre), REGION.radius
    expected = fused_points(points, depths, poses, FOCAL, fused.voxel, carve=False, region=region)
    wrong = np.abs(fused.volume[tuple(index.T)] - expected) > 1e-3
    # Points within rounding of a texel border or of a threshold may fall on its other side.
    assert wrong.mean() < 0.005, wrong.mean()
    assert (expected == -1).any() and (expected == 1).any() and (np.abs(expected) < 0.9).mean() > 0.05


def test_near_and_far_surfaces_are_within_a_voxel(ball_mesh: Mesh) -> None:
    vertices = ball_mesh.vertices.astype(np.float64)
    assert ball_mesh.voxel == pytest.approx(REGION.radius / 32)
    distance = np.linalg.norm(vertices - np.array(REGION.centre), axis=1) / REGION.radius
    place = REGION.contract(vertices)
    voxel = 1 / 32
    on_ball = np.abs(np.linalg.norm(vertices - BALL, axis=1) - BALL_RADIUS) / ball_mesh.voxel
    level = vertices.copy()
    level[:, 2] = FLOOR
    on_floor = np.linalg.norm(REGION.contract(level) - place, axis=1) / voxel
    seen = distance < 12  # farther, no view's image has a pixel for a voxel
    error = np.minimum(on_ball, on_floor)[seen]
    measured = np.quantile(error, 0.99), np.sqrt(np.mean(error**2))
    assert measured[0] < 1 and measured[1] < 0.35, measured
    assert (on_ball < 1).sum() > 500 and (distance[on_floor < 1] > 8).sum() > 100


def test_it_is_closed_but_for_the_end_of_space_and_winds_outward(ball_mesh: Mesh) -> None:
    solid = trimesh.Trimesh(ball_mesh.vertices.astype(np.float64), ball_mesh.faces, process=False)
    assert solid.is_winding_consistent
    edges, count = np.unique(np.sort(solid.edges, axis=1), axis=0, return_counts=True)
    single = ball_mesh.vertices[np.unique(edges[count == 1])]
    place = np.linalg.norm(REGION.contract(single), axis=1)
    assert len(single) and place.min() > 2 - 6 / 32  # the floor ends where space does, and nowhere else
    middle, normal = solid.triangles_center, solid.face_normals
    near = np.linalg.norm(middle - np.array(REGION.centre), axis=1) < 4
    ball = near & (np.abs(np.linalg.norm(middle - BALL, axis=1) - BALL_RADIUS) < 0.5 * ball_mesh.voxel)
    outward = (middle - BALL) / np.linalg.norm(middle - BALL, axis=1, keepdims=True)
    assert np.quantile(np.sum(normal * outward, axis=1)[ball], 0.05) > 0.8
    floor = near & ~ball & (np.linalg.norm(middle[:, :2] - BALL[:2], axis=1) > 0.6)
    assert np.quantile(normal[floor, 2], 0.05) > 0.8


def test_a_room_is_a_cavity_that_stays() -> None:
    """A ball in a closed box: what is behind walls was never seen, and a small thing near is no floater."""
    half = np.full(3, 4.0)

    def shape(points: np.ndarray) -> np.ndarray:
        ball = np.linalg.norm(points - BALL, axis=-1) - 0.2
        return np.minimum(ball, np.min(half - np.abs(points), axis=-1))

    poses = [look_at(BALL + eye, BALL + 0.01) for eye in 2.0 * trimesh.creation.icosphere(1).vertices]
    poses += [look_at(BALL - eye / 4, BALL + 3 * eye) for eye in trimesh.creation.icosphere(0).vertices]
    depths = [ref.depth_map(shape, pose, FOCAL, SIZE) for pose in poses]
    mesh = extract_mesh(fuse(depths, poses, 48, REGION))
    away = np.abs(shape(mesh.vertices.astype(np.float64)))
    near = np.linalg.norm(mesh.vertices - BALL, axis=1) < 0.5
    assert near.sum() > 50 and (~near).sum() > 1000
    assert np.quantile(away[near], 0.95) < mesh.voxel
    solid = trimesh.Trimesh(mesh.vertices.astype(np.float64), mesh.faces, process=False)
    inward = -np.sum(solid.face_normals * solid.triangles_center, axis=1)
    far = np.linalg.norm(solid.triangles_center - BALL, axis=1) > 2
    assert np.quantile(inward[far], 0.05) > 0  # walls face the room


def sheet(normal: np.ndarray, points: np.ndarray, size: float) -> Surfels:
    """Opaque round surfels of one normal."""
    normals, rng = np.tile(normal, (len(points), 1)), np.random.default_rng(0)
    raw = from_points(points, normals, rng=rng, attributes=["radiance_sh"], opacity=0.99).to_numpy()
    raw["scale"] = np.full_like(raw["scale"], np.log(size))
    return Surfels.from_numpy(raw)


def test_relighting_keeps_what_is_around_out_of_the_mesh() -> None:
    grid = np.stack(np.meshgrid(np.linspace(-1, 1, 9), np.linspace(-1, 1, 9)), axis=-1).reshape(-1, 2)
    raw = sheet(np.array([0.0, 0.0, 1.0]), np.column_stack([grid, np.zeros(len(grid))]), 0.1).to_numpy()
    raw |= {"albedo": np.zeros((81, 3)), "metallic": np.zeros((81, 1)), "roughness": np.zeros((81, 1))}
    balls = [trimesh.creation.icosphere(2, 0.08), trimesh.creation.icosphere(2, 0.5)]
    balls[1].apply_translation([6, 0, 0])
    joined: Any = trimesh.util.concatenate(balls)
    mesh = Mesh(np.asarray(joined.vertices, np.float32), np.asarray(joined.faces, np.uint32), 0.01)
    surfels = Surfels.from_numpy({name: np.asarray(values, np.float32) for name, values in raw.items()})
    shading = Shading(diffuse="irradiance", occlusion=True)
    scene = TrainedScene(surfels, EnvironmentLight.constant(1.0, 8), mesh, shading, 1, 0.0)
    assert relightable(scene).mesh is mesh
    lit = relightable(replace(scene, surroundings=Surroundings(surfels)))
    assert lit.mesh is not None and lit.surroundings is None
    np.testing.assert_allclose(np.linalg.norm(lit.mesh.vertices, axis=1), 0.08, rtol=1e-3)
    assert len(lit.mesh.faces) == len(balls[0].faces)
