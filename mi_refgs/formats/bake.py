"""The mesh of a run with textures of its materials, which formats of meshes share.

Materials and normals are those of the pictures: the surfels as they are blended in many views, averaged where
a point of the mesh is seen. Points that no view sees take them from the surfels around the mesh's vertices.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_refgs.errors import SceneError
from mi_refgs.formats.format import Shot, module
from mi_refgs.formats.last_made import LastMade
from mi_refgs.formats.surface import surface, texels, unwrap
from mi_refgs.formats.textured import TexturedMesh, check
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.memory import BASE, PER_SHOWN_SURFEL, PER_TEXEL, require
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import NORMAL_AGREEMENT, VertexSurfels
from mi_refgs.occlusion.visibility import OFFSET_VOXELS, Occluder
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.points import safe_normalize
from mi_refgs.shade.shading import Shading
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import Surfels

PACKAGES = "fast_simplification", "xatlas"
"""What the baking itself needs of the extra; the former is called by trimesh."""
VIEWS = 64
"""Views that look at the surfels, spread evenly over the cameras of the fit: a point is seen by a third."""
VIEW_SIZE = 512
"""Pixels along the longer side of their pictures, of which an object of 128 voxels has four a voxel."""
OUTLINES = 8
"""Views whose outlines say how far the mesh lies below the surface, about."""
GROWTH, HALVINGS = 2.0, 6
"""Voxels that the mesh is moved out, at most, and steps of the search: to 1/32 voxel."""
UNSEEN = 1e-2
"""Weight of the surfels around a vertex beside that of views, each up to 1: they decide where none sees."""
COLUMNS = 8
"""Albedo (3), metallic, roughness, normal (3)."""


_BAKED: LastMade[TexturedMesh] = LastMade()


def bake(trained: TrainedScene, shots: Sequence[Shot], faces: int, texture: int) -> TexturedMesh:
    """The object of a scene as a mesh of at most about `faces` triangles with textures of texture² texels.

    Surroundings stay out: the object alone, under the light of the fit (`runs.relightable` says which
    materials it gets). Raises InputError for a scene without mesh, light or materials, numbers out of range,
    and missing packages.
    """
    check(faces, texture)
    require(
        BASE + PER_TEXEL * texture**2 + PER_SHOWN_SURFEL * trained.count,
        f"--texture: {texture} × {texture} texels",
        "bake a smaller texture",
    )
    asked = faces, texture, *shots
    return _BAKED.get(trained, asked, lambda: _bake(trained, shots, faces, texture))


def _bake(trained: TrainedScene, shots: Sequence[Shot], faces: int, size: int) -> TexturedMesh:
    for package in PACKAGES:
        module(package)
    scene = relightable(trained)
    if scene.mesh is None or scene.light is None:
        raise SceneError("mesh: the run has none; fit one with occlusion, as `--for relighting` does")
    plain = replace(scene, shading=Shading("pixel", "split_sum", "irradiance", False))
    chosen = np.unique(np.linspace(0, len(shots) - 1, VIEWS).round().astype(int))
    views = [shots[i].camera.resized(VIEW_SIZE) for i in chosen]
    with dr.suspend_grad():
        renderer = plain.renderer()
        mesh = _grown(surface(scene.mesh, faces), views[:: len(views) // OUTLINES + 1], renderer)
        chart = unwrap(mesh, size)
        covered, triangle, barycentric = texels(chart, size)
        points, start = _places(mesh, scene.surfels, triangle, barycentric)
        found = _seen(views, renderer, points, start, OFFSET_VOXELS * mesh.voxel)
    count = len(mesh.vertices)
    maps = _padded(covered, found[count:, :5])
    return TexturedMesh(
        mesh.vertices[chart.vertex],
        found[:count, 5:][chart.vertex],
        chart.uv.astype(np.float32),
        chart.faces,
        maps[..., :3],
        maps[..., 3],
        maps[..., 4],
        scene.light,
    )


def _grown(mesh: Mesh, views: Sequence[Camera], renderer: Callable[[Camera], Frame]) -> Mesh:
    """The mesh, moved along its normals until it covers as much of the views as the surfels do.

    Expected depths, of which it was made, lie behind the first surfels that they average.
    """
    wanted = [frame.object_alpha for frame in map(renderer, views)]
    covered = sum(float(dr.sum(share)[0]) for share in wanted)
    normals = _normals(mesh)

    def excess(voxels: float) -> float:
        moved = Occluder(replace(mesh, vertices=_moved(mesh, normals, voxels)))
        return sum(float(dr.count(moved.first_hit(*_rays(view))[1])[0]) for view in views) - covered

    low, high = 0.0, GROWTH
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return replace(mesh, vertices=_moved(mesh, normals, (low + high) / 2))


def _moved(mesh: Mesh, normals: np.ndarray, voxels: float) -> np.ndarray:
    return (mesh.vertices + voxels * mesh.voxel * normals).astype(np.float32)


def _rays(view: Camera) -> tuple[Any, Any]:
    """Origins and directions through the pixel centres."""
    directions = view.rays()
    return mi.Point3f(view.origin + dr.zeros(mi.Point3f, dr.width(directions))), directions


def _normals(mesh: Mesh) -> np.ndarray:
    """Outward unit normals (V, 3) float32 of the triangles around each vertex."""
    # In voxels: trimesh takes triangles of less than 1e-14 square units for points.
    scaled = (mesh.vertices - mesh.vertices[0]) / mesh.voxel
    return np.array(trimesh.Trimesh(scaled, mesh.faces, process=False).vertex_normals, np.float32)


def _places(mesh: Mesh, surfels: Surfels, triangle: Any, barycentric: Any) -> tuple[Any, list[Any]]:
    """The mesh's vertices, then the points on its triangles: where they are (mi.Point3f), and their COLUMNS
    by the surfels around the vertices and the normals of the mesh."""
    around = VertexSurfels.of(mesh, surfels)
    vertices = [dr.arange(mi.UInt32, len(mesh.vertices))]
    corners = [dr.gather(mi.UInt32, around.faces, 3 * triangle + i) for i in range(3)]
    shares = (1 - barycentric.x - barycentric.y, barycentric.x, barycentric.y)

    def everywhere(column: Any) -> Any:
        mixed = sum(s * dr.gather(mi.Float, column, c) for s, c in zip(shares, corners, strict=True))
        return dr.concat((dr.gather(mi.Float, column, vertices[0]), mixed))

    rows = around.surface(surfels).rows
    materials = [dr.gather(mi.Float, rows, COLUMNS * vertices[0] + i) for i in range(5)]
    columns = [*materials, *(upload(column) for column in _normals(mesh).T)]
    points = mi.Point3f(*(everywhere(upload(column)) for column in mesh.vertices.T))
    start = [everywhere(column) for column in columns]
    return points, [*start[:5], *safe_normalize(mi.Vector3f(*start[5:]))]


def _seen(
    views: Sequence[Camera],
    renderer: Callable[[Camera], Frame],
    points: Any,
    start: list[Any],
    reach: float,
) -> np.ndarray:
    """COLUMNS of each point (P, COLUMNS) float32, the mean over the views that see it, from those at `start`.

    A view counts by its alpha and the squared cosine at which it sees the point; it sees what is less than
    `reach` before or behind its expected depth.
    """
    outward = mi.Vector3f(*start[5:])
    weight = dr.full(mi.Float, UNSEEN, dr.width(points))
    total = [UNSEEN * column for column in start]
    for view in views:
        share, values = _look(view, renderer(view), points, outward, dr.opaque(mi.Float, reach))
        weight += share
        total = [a + b for a, b in zip(total, values, strict=True)]
        dr.eval(weight, total)
    normal = safe_normalize(mi.Vector3f(*total[5:]))
    # At a rim pixels blend normals of two faces.
    normal = dr.select(dr.dot(normal, outward) > NORMAL_AGREEMENT, normal, outward)
    mean = [*(column / weight for column in total[:5]), *normal]
    return np.stack([np.array(column, np.float32) for column in mean], axis=1)


def _look(camera: Camera, frame: Frame, points: Any, outward: Any, reach: Any) -> tuple[Any, list[Any]]:
    """Weight of a view at points, and the weighted COLUMNS: bilinear, of pixels whose depth is theirs."""
    normal = safe_normalize(frame.normal)
    rows = [*frame.maps["albedo"], frame.maps["metallic"], frame.maps["roughness"], *normal]
    table = dr.ravel(mi.ArrayXf([*rows, frame.alpha, frame.depth]))
    local = camera.to_camera(points)
    before = local.z > camera.near
    inverse = dr.rcp(dr.select(before, local.z, 1))
    x = dr.fma(local.x * inverse, camera.fx, camera.cx) - 0.5
    y = dr.fma(local.y * inverse, camera.fy, camera.cy) - 0.5
    left, top = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
    facing = dr.maximum(-dr.dot(safe_normalize(camera.towards(points)), outward), 0)
    weight, total = mi.Float(0), [mi.Float(0)] * COLUMNS
    for across, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, line = left + across, top + down
        inside = before & (column >= 0) & (column < camera.width) & (line >= 0) & (line < camera.height)
        pixel = mi.UInt32(dr.select(inside, line * camera.width + column, 0))
        values = [dr.gather(mi.Float, table, (COLUMNS + 2) * pixel + i, inside) for i in range(COLUMNS + 2)]
        alpha, depth = values[COLUMNS:]
        beside = dr.abs(x - mi.Float(column)), dr.abs(y - mi.Float(line))
        share = dr.maximum(1 - beside[0], 0) * dr.maximum(1 - beside[1], 0) * alpha * facing**2
        share = dr.select(inside & (dr.abs(depth - local.z) < reach), share, 0)
        weight += share
        total = [dr.fma(share, v, sum_) for v, sum_ in zip(values[:COLUMNS], total, strict=True)]
    return weight, total


def _padded(covered: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (T, C) of the texels that are `covered` (N, N), and of the nearest of them elsewhere: no lookup
    at a seam, or in a smaller copy of the texture, meets a texel of no surface."""
    from scipy import ndimage

    image = np.zeros((*covered.shape, values.shape[1]), np.float32)
    image[covered] = values
    rows, columns = ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)
    return np.clip(image[rows, columns], 0, 1)
