"""Bake a scene to a textured mesh, which the mesh formats share. Materials and normals are those of rendered
views: of the blended surfels, averaged over the views that see a point of the mesh. Points that no view sees
get those of the surfels around the mesh's vertices."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh
from scipy import ndimage

from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError, require_between, require_package
from mi_refgs.formats.format import Shot
from mi_refgs.io.progress import warn
from mi_refgs.kernels.device import upload
from mi_refgs.kernels.memory import BASE, PER_SHOWN_SURFEL, PER_TEXEL, require
from mi_refgs.occlusion.mesh import Mesh, clean
from mi_refgs.occlusion.surface_materials import NORMAL_AGREEMENT, VertexSurfels, corners_of
from mi_refgs.occlusion.visibility import OFFSET_VOXELS, Occluder
from mi_refgs.render.pipeline import Frame
from mi_refgs.runs.relightable import relightable
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.points import safe_normalize
from mi_refgs.shade.reflectance import Reflectance
from mi_refgs.splat.camera import Camera
from mi_refgs.surfels.table import vector_of
from mi_refgs.types import Array, Float, Point2f, Point3f, UInt32, Vector3f

SMOOTHING = 30  # steps of the filter that removes stairs of voxels and keeps the volume [Taubin 1995]
PADDING = 4  # texels between charts, so that two mip levels, and bilinear lookup in them, see no other chart
FLAT = 1e-6  # voxel of the texture's plane as a mesh: its rays have length 1 and need next to no offset
VIEWS = 64  # rendered views, spread evenly over the cameras of the fit; about a third of them see a point
VIEW_SIZE = 512  # pixels along the longer side of a rendered view: four per voxel of an object of 128 voxels
OUTLINES = 8  # approximate number of views whose outlines show how far the mesh lies below the surface
GROWTH, HALVINGS = 2.0, 6  # voxels by which the mesh is moved outwards, at most, and bisection steps
UNSEEN = 1e-2  # weight of the surfels around a vertex, where each view weighs up to 1
COLUMNS = 8  # columns per point: albedo (3), metallic, roughness, normal (3)


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh in world space, its materials, and the light. V vertices, F faces, N texels a side."""

    vertices: np.ndarray  # (V, 3) float32
    normals: np.ndarray  # (V, 3) float32, unit, outward
    uv: np.ndarray  # (V, 2) float32 in 0 … 1, v upwards: the first row of a texture is at v = 1
    faces: np.ndarray  # (F, 3) uint32, counter-clockwise from outside
    albedo: np.ndarray  # (N, N, 3) float32, linear
    metallic: np.ndarray  # (N, N) float32
    roughness: np.ndarray  # (N, N) float32, perceptual: GGX's α is its square
    light: EnvironmentLight


@lru_cache(maxsize=1)  # for the next format of the same scene
def bake(trained: TrainedScene, shots: tuple[Shot, ...], faces: int, texture: int) -> TexturedMesh:
    """Bake the object to a mesh of at most about `faces` triangles with textures of texture² texels.
    Background Gaussians are left out (`runs.relightable` says which materials the object gets). Raises
    InputError for a scene without mesh, light or materials, numbers out of range, and missing packages."""
    require_between(faces, "--faces", 100)
    require_between(texture, "--texture", 16, 8192)
    memory = BASE + PER_TEXEL * texture**2 + PER_SHOWN_SURFEL * trained.count
    require(memory, f"--texture: {texture} × {texture} texels", "bake a smaller texture")
    for package in ("fast_simplification", "xatlas"):  # trimesh calls the former
        require_package(package, "export", "--to")
    scene = relightable(trained)
    if scene.mesh is None or scene.light is None:
        remedy = "fit one with occlusion, as `--for relighting` does, or longer: no mesh was extracted"
        raise InputError("the run has none", "mesh", remedy=remedy)
    model = scene.shading.model
    if model.textures(scene.surfels.values(scene.shading.required_attributes)) is None:
        remedy = "export `scene.xml`, or another model"
        raise InputError(f"{model.name} has no textures", "reflectance", remedy=remedy)
    owner: Any = next(kind for kind in type(model).__mro__ if "textures" in vars(kind))
    if lost := {*scene.shading.required_attributes} - {*owner.required_attributes(model, scene.shading)}:
        warn(f"{', '.join(lost)}: not exported; `{model.name}` needs a method `textures` that uses it")
    # Views that show the object's materials.
    plain = replace(scene, shading=scene.shading.untraced())
    views = [shots[i].camera.resized(VIEW_SIZE) for i in evenly_spread(len(shots), VIEWS)]
    with dr.suspend_grad():
        renderer = plain.renderer()
        # The mesh, and its charts in the texture.
        mesh = _grown(simplified(scene.mesh, faces), views[:: len(views) // OUTLINES + 1], renderer)
        vertex, cut_faces, uv = unwrap(mesh, texture)
        covered, triangle, barycentric = texels(cut_faces, uv, texture)
        # Materials and normals at vertices and texels.
        points, start = _points(mesh, scene, triangle, barycentric)
        pairs = ((v, f, _columns(model, f.maps)) for v, f in zip(views, map(renderer, views), strict=True))
        found = _mean_of_views(pairs, points, start, OFFSET_VOXELS * mesh.voxel)
    count = len(mesh.vertices)
    image = np.zeros((texture, texture, 5), np.float32)
    image[covered] = found[count:, :5]
    # Texels beside the charts get the nearest value.
    rows, columns = ndimage.distance_transform_edt(~covered, return_distances=False, return_indices=True)
    maps = np.clip(image[rows, columns], 0, 1)
    shape = (mesh.vertices[vertex], found[:count, 5:][vertex], uv.astype(np.float32), cut_faces)
    return TexturedMesh(*shape, maps[..., :3], maps[..., 3], maps[..., 4], scene.light)


def simplified(mesh: Mesh, faces: int) -> Mesh:
    """Smooth a mesh, reduce it to at most about `faces` triangles by edge collapse, and remove floaters."""
    if not len(mesh.faces):
        what = "the run has none that textures could be baked to"
        raise InputError(what, "mesh", remedy="train it for longer")
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0).max()
    made = trimesh.Trimesh((mesh.vertices - low) / size, mesh.faces, process=False)
    made.merge_vertices()  # a seam of texture coordinates would tear
    trimesh.smoothing.filter_taubin(made, iterations=SMOOTHING)
    if len(made.faces) > faces:
        made = made.simplify_quadric_decimation(face_count=faces)
    # A part that the box of an object has cut open could count as the wall of a cavity.
    whole = clean(np.asarray(made.vertices), np.asarray(made.faces), mesh.voxel, open_=True)
    return Mesh(whole.vertices * size + low, whole.faces, mesh.voxel)


def unwrap(mesh: Mesh, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cut a mesh into charts that fill a texture of size² texels without overlap; some are mirrored. Returns
    for the V vertices of the cut mesh the index (V,) in the mesh, its faces (F, 3) in the same order, and the
    texture coordinates (V, 2) in 0 … 1, v upwards."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh((mesh.vertices - mesh.vertices[0]) / mesh.voxel, mesh.faces)  # it drops tiny triangles
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = size, PADDING
    atlas.generate(xatlas.ChartOptions(), packing)
    vertex, faces, uv = atlas[0]
    return np.asarray(vertex), np.asarray(faces, np.uint32), np.clip(np.asarray(uv, np.float64), 0, 1)


def texels(faces: np.ndarray, uv: np.ndarray, size: int) -> tuple[np.ndarray, UInt32, Point2f]:
    """Find the texels of a size² texture whose centre lies in a triangle. Returns which they are (size, size)
    bool, the first row at v = 1, and for the T of them, row by row, the triangle (T,) and the barycentric
    coordinates (T,) of its second and third corner."""
    plane = Occluder(Mesh(np.pad(uv, ((0, 0), (0, 1))), faces, FLAT))
    row, column = np.divmod(np.arange(size * size), size)
    above = mi.Point3f(upload((column + 0.5) / size), upload(1 - (row + 0.5) / size), mi.Float(1))
    hit = plane.closest(above, mi.Vector3f(0, 0, -1), None)
    covered = hit.valid.numpy()
    found = np.flatnonzero(covered)
    barycentric = mi.Point2f(*(upload(x.numpy()[found]) for x in hit.barycentric))
    return covered.reshape(size, size), upload(hit.triangle.numpy()[found], mi.UInt32), barycentric


def _grown(mesh: Mesh, views: Sequence[Camera], renderer: Callable[[Camera], Frame]) -> Mesh:
    """Move a mesh of expected depths along its normals until it covers as many pixels as the surfels do."""
    covered = sum(float(dr.sum(renderer(view).object_alpha)[0]) for view in views)
    normals = mesh.normals().astype(np.float32)

    def moved(voxels: float) -> Mesh:
        return replace(mesh, vertices=(mesh.vertices + voxels * mesh.voxel * normals).astype(np.float32))

    def excess(voxels: float) -> float:
        occluder = Occluder(moved(voxels))
        hits = (occluder.first_hit(view.origin, view.rays())[1] for view in views)
        return sum(float(dr.count(hit)[0]) for hit in hits) - covered

    low, high = 0.0, GROWTH
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return moved((low + high) / 2)


def _columns(model: Reflectance, values: Mapping[str, Array]) -> list[Float]:
    made = model.textures(values)
    assert made is not None  # `bake` refuses others
    return [*made["albedo"], made["metallic"], made["roughness"]]


def _points(
    mesh: Mesh, scene: TrainedScene, triangle: UInt32, barycentric: Point2f
) -> tuple[Point3f, list[Float]]:
    """Positions (V + T,) of the mesh's vertices and T points, their COLUMNS by surfels and mesh normals."""
    nearby = VertexSurfels.of(mesh, scene.surfels)
    vertices = dr.arange(mi.UInt32, len(mesh.vertices))
    corners = corners_of(nearby.faces, triangle, barycentric, True)

    def interpolated(column: Float) -> Float:
        mixed = sum(share * dr.gather(mi.Float, column, vertex) for vertex, share in corners)
        return dr.concat((dr.gather(mi.Float, column, vertices), mixed))

    columns = nearby.values(scene.surfels, scene.shading.required_attributes)
    values = {name: vector_of(own) for name, own in columns.items()}
    materials = [interpolated(column) for column in _columns(scene.shading.model, values)]
    normal = mi.Vector3f(*(interpolated(upload(column)) for column in mesh.normals().astype(np.float32).T))
    points = mi.Point3f(*(interpolated(upload(column)) for column in mesh.vertices.T))
    return points, [*materials, *safe_normalize(normal)]


def _mean_of_views(
    views: Iterable[tuple[Camera, Frame, list[Float]]],  # with albedo, metallic and roughness of the pixels
    points: Point3f,  # (P,)
    start: list[Float],  # COLUMNS × (P,)
    reach: float,  # scene units
) -> np.ndarray:
    """COLUMNS (P, COLUMNS) float32 averaged over the views, from those at `start`. A view sees points less
    than `reach` off its expected depth, and weighs by its alpha and the squared cosine."""
    outward = mi.Vector3f(*start[5:])
    weight = dr.full(mi.Float, UNSEEN, dr.width(points))
    total = [UNSEEN * column for column in start]
    for view in views:
        own, values = _sample_view(*view, points, outward, dr.opaque(mi.Float, reach))
        weight += own
        total = [a + b for a, b in zip(total, values, strict=True)]
        dr.eval(weight, total)
    normal = safe_normalize(mi.Vector3f(*total[5:]))
    # At a rim pixels blend normals of two faces.
    normal = dr.select(dr.dot(normal, outward) > NORMAL_AGREEMENT, normal, outward)
    mean = [*(column / weight for column in total[:5]), *normal]
    return np.stack([np.array(column, np.float32) for column in mean], axis=1)


def _sample_view(
    camera: Camera,
    frame: Frame,
    materials: list[Float],  # albedo, metallic, roughness of its pixels
    points: Point3f,  # (P,)
    outward: Vector3f,  # (P,) unit normals
    reach: Float,  # scene units
) -> tuple[Float, list[Float]]:
    """Return a view's weight at points (P,), and the weighted COLUMNS: bilinear, of pixels at their depth."""
    # Interleaved rows of pixels: COLUMNS, alpha, depth.
    table = dr.ravel(mi.ArrayXf([*materials, *safe_normalize(frame.normal), frame.alpha, frame.depth]))
    # Raster positions of the points, and the cosines at which the view sees them.
    local = camera.to_camera(points)
    before = local.z > camera.near
    inverse = dr.rcp(dr.select(before, local.z, 1))
    x = dr.fma(local.x * inverse, camera.fx, camera.cx) - 0.5
    y = dr.fma(local.y * inverse, camera.fy, camera.cy) - 0.5
    left, top = mi.Int32(dr.floor(x)), mi.Int32(dr.floor(y))
    facing = dr.maximum(-dr.dot(safe_normalize(camera.towards(points)), outward), 0)
    # The four pixels around each position.
    weight, total = mi.Float(0), [mi.Float(0)] * COLUMNS
    for across, down in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, line = left + across, top + down
        inside = before & (column >= 0) & (column < camera.width) & (line >= 0) & (line < camera.height)
        pixel = mi.UInt32(dr.select(inside, line * camera.width + column, 0))
        values = [dr.gather(mi.Float, table, (COLUMNS + 2) * pixel + i, inside) for i in range(COLUMNS + 2)]
        alpha, depth = values[COLUMNS:]
        near_x, near_y = (dr.maximum(1 - dr.abs(d), 0) for d in (x - mi.Float(column), y - mi.Float(line)))
        own = near_x * near_y * alpha * facing**2
        own = dr.select(inside & (dr.abs(depth - local.z) < reach), own, 0)
        weight += own
        total = [dr.fma(own, v, sum_) for v, sum_ in zip(values[:COLUMNS], total, strict=True)]
    return weight, total
