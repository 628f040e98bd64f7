"""Visibility through an extracted mesh against sphere tracing of the true shape."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh

from mi_refgs.occlusion import tsdf, visibility
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.reference import occlusion as ref
from tests.helpers import unit, vector, with_grad
from tests.scenes.integrator import joined

GRID = 64
HALF = 1.3

SHAPES = {
    "sphere": ref.sphere((0, 0, 0), 1),
    "ball before a wall": ref.union(ref.sphere((0, 0, 0.25), 0.5), ref.box((0, 0, -0.6), (1, 1, 0.15))),
    "facing plates": ref.union(*(ref.box((0, 0, z), (0.8, 0.8, 0.15)) for z in (0.5, -0.5))),
    "torus": ref.torus(0.8, 0.3),
}


def extracted(shape: ref.Shape, noise: float = 0.0) -> Mesh:
    """Mesh of the shape's sampled distance field, with noise in voxels as a fit would have it."""
    grid = np.stack(np.meshgrid(*[np.linspace(-HALF, HALF, GRID)] * 3, indexing="ij"), axis=-1)
    voxel = 2 * HALF / (GRID - 1)
    field = shape(grid) + noise * voxel * np.random.default_rng(4).normal(size=grid.shape[:3])
    volume = (field / (5 * voxel)).clip(-1, 1).astype(np.float32)
    return extract_mesh(tsdf.TSDF(volume, np.full(3, -HALF), voxel))


def mirror_rays(shape: ref.Shape, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points that cameras around the shape see, outward normals, mirror directions; grazing ones included."""
    rng = np.random.default_rng(5)
    eye = 4 * unit(rng.normal(size=(count, 3)))
    view = unit(rng.uniform(-1, 1, (count, 3)) - eye)
    t = ref.trace(shape, eye, view)
    hit = np.isfinite(t)
    point, view = eye[hit] + t[hit, None] * view[hit], view[hit]
    normal = ref.normal(shape, point)
    cosine = np.sum(view * normal, axis=1, keepdims=True)
    facing = cosine[:, 0] < -1e-3
    return point[facing], normal[facing], (view - 2 * cosine * normal)[facing]


@pytest.mark.parametrize("name", SHAPES)
def test_mirror_rays_against_the_true_shape(name: str) -> None:
    """Points up to half a voxel off the surface, either side, noisy mesh: few false or missed occlusions."""
    shape = SHAPES[name]
    mesh = extracted(shape, noise=0.2)
    occluder = Occluder(mesh)
    point, normal, mirror = mirror_rays(shape, 30000)
    truth = ref.visible(shape, point, mirror, 1e-4)
    shift = np.random.default_rng(6).uniform(-0.5, 0.5, (len(point), 1)) * mesh.voxel
    answer = occluder.visible(mi.Point3f(vector(point + shift * normal)), vector(mirror), vector(normal))
    seen = np.array(answer) == 1
    grazing = np.sum(mirror * normal, axis=1) < 0.2
    false_occlusion, missed = np.mean(truth & ~seen), np.mean(~truth & seen)
    assert grazing.sum() > 100 and np.mean((truth & ~seen)[grazing]) < 0.02
    assert false_occlusion < 0.003 and missed < 0.003  # of grazing rays, which start beside themselves
    assert seen.all() if name == "sphere" else np.mean(~truth) > 0.03


def test_offset_is_what_prevents_self_occlusion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Points a whole voxel below the surface; without the offset the two-sided test hides them all."""
    shape = SHAPES["sphere"]
    mesh = extracted(shape)
    occluder = Occluder(mesh)
    point, normal, mirror = mirror_rays(shape, 2000)
    args = mi.Point3f(vector(point - mesh.voxel * normal)), vector(mirror), vector(normal)
    assert dr.all(occluder.visible(*args) == 1)
    assert np.array(occluder.visible(args[0], args[1]))[np.sum(mirror * normal, axis=1) > 0.6].all()
    monkeypatch.setattr(visibility, "OFFSET_VOXELS", 0.0)
    assert dr.mean(occluder.visible(*args))[0] < 0.01


def test_no_mesh_is_visible_and_traces_nothing() -> None:
    """Before the first extraction, and after one that found nothing."""
    origin, direction = dr.zeros(mi.Point3f, 5), mi.Vector3f(0, 0, 1)
    for occluder in (Occluder(), Occluder(Mesh.empty())):
        before = dr.detail.launch_stats()[0]
        answer = occluder.visible(origin, direction)
        assert dr.detail.launch_stats()[0] == before
        assert dr.width(answer) == 5 and dr.all(answer == 1)
    assert Occluder().mesh is None


def test_updates_in_place_compile_nothing() -> None:
    """Other counts, an empty mesh in between: the answers follow, the kernel and the scene stay."""
    occluder = Occluder()
    origin, direction = mi.Point3f(0, 0, [-5, -5, 5]), mi.Vector3f(0, 0, [1, -1, 1])

    def answer(radius: float, level: int) -> list[float]:
        occluder.update(joined(0.1 * radius, trimesh.creation.icosphere(level, radius)))
        return np.array(occluder.visible(origin, direction, direction)).tolist()

    assert answer(1.0, 2) == [0, 1, 1]
    scene = occluder._scene
    before = dr.detail.launch_stats()
    assert answer(7.0, 3) == [0, 0, 0]
    occluder.update(Mesh.empty())
    assert dr.all(occluder.visible(origin, direction) == 1)
    assert answer(0.5, 1) == [0, 1, 1]
    assert dr.detail.launch_stats()[1:] == (before[1], before[2]), "recompiled"
    assert occluder._scene is scene
    saved = occluder.mesh
    assert saved is not None
    assert np.array(Occluder(saved).visible(origin, direction, direction)).tolist() == [0, 1, 1]


def test_detached_and_total_on_degenerate_rays() -> None:
    """No gradient arrives; zero and non-finite directions or origins are visible, never NaN."""
    occluder = Occluder(extracted(SHAPES["sphere"]))
    direction = with_grad(mi.Vector3f(mi.Float([0.0, np.nan, np.inf, 1e30, 1e-30, 1.0]), 0, 0))
    origin = with_grad(mi.Point3f(mi.Float([-5, -5, -5, -5, -5, np.nan]), 0, 0))
    answer = occluder.visible(origin, direction, direction)
    assert not dr.grad_enabled(answer)
    assert np.isin(np.array(answer), (0.0, 1.0)).all()
    assert np.array(answer)[[0, 1, 2, 5]].all()
    normal = dr.zeros(mi.Vector3f, 1)
    assert np.array(occluder.visible(mi.Point3f(-5, 0, 0), mi.Vector3f(1, 0, 0), normal)).tolist() == [0]


def test_meshes_are_made_and_read_as_mitsuba_3_10_has_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Made of tensors, by keyword, and read without the methods that it renamed. [mitsuba3, #1933]"""
    box = trimesh.creation.box((1, 2, 3))
    vertices, faces = box.vertices.astype(np.float32), box.faces.astype(np.uint32)
    made = visibility._mitsuba_mesh("box", Mesh(vertices, faces, 0.1))
    read = visibility.mesh_arrays(SimpleNamespace(write_ply=made.write_ply))
    for found, expected in zip(read, (vertices, faces), strict=True):
        np.testing.assert_array_equal(found, expected)
    later = SimpleNamespace(Mesh=lambda name, **given: given, TensorXf=mi.TensorXf, TensorXu=mi.TensorXu)
    monkeypatch.setattr(visibility, "mi", later)
    given = visibility._mitsuba_mesh("box", Mesh(vertices, faces, 0.1))
    np.testing.assert_array_equal(given["positions"].numpy(), vertices)
    np.testing.assert_array_equal(given["faces"].numpy(), faces)
