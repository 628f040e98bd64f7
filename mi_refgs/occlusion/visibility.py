"""Visibility of the light through Mitsuba's rays: one bit per ray, whether the extracted mesh blocks it."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import trimesh

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import Surface, VertexColours, VertexSurfels
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Array, Bool, Float, Point2f, Point3f, Scene, UInt32, Vector3f

OFFSET_VOXELS = 2.0  # of a ray's origin off the surface: above the mesh's error (0.4) and the depth's
ALONG = 2.5  # offsets along the ray at most, which stays where it is: what is nearer is not hit


@dataclass(frozen=True)
class Hit:
    """First hits of N rays, detached."""

    valid: Bool  # whether something is hit
    point: Point3f  # world
    triangle: UInt32
    barycentric: Point2f  # of the triangle's second and third corner


class Occluder:
    """The extracted mesh in a private scene, updated in place: evaluate `visible` before `update`."""

    NAME = "occluder"

    def __init__(self, mesh: Mesh | None = None) -> None:
        self.mesh: Mesh | None = None  # the present one; None before the first `update`
        self._scene: Scene = None
        self._params: Any = None
        self._variant: str | None = None
        self.vertex_surfels: VertexSurfels | None = None  # of this mesh; None also after edits of the surfels
        self.ambient: VertexColours | None = None  # ambient visibility of this mesh
        if mesh is not None:
            self.update(mesh)

    def update(self, mesh: Mesh) -> None:
        """Replace the mesh. Vertex and face counts may change, to zero too; compiled kernels stay valid."""
        self.mesh, self.vertex_surfels, self.ambient = mesh, None, None
        if not len(mesh.faces):
            return
        if self._scene is None or self._variant != mi.variant():
            self._variant = mi.variant()
            self._scene = mi.load_dict({"type": "scene", self.NAME: _mitsuba_mesh(self.NAME, mesh)})
            self._params = mi.traverse(self._scene)
        else:
            _set_mesh(self._params, f"{self.NAME}.", mesh)

    @property
    def empty(self) -> bool:
        """Whether there is nothing to hit."""
        return self.mesh is None or not len(self.mesh.faces)

    def set_materials(self, surfels: Surfels) -> None:
        """Find the surfels around every vertex for `surface`, after `update` and when surfels move or their
        number changes. Raises InputError without any."""
        self.vertex_surfels = None
        if self.mesh is not None and not self.empty:
            self.vertex_surfels = VertexSurfels.of(self.mesh, surfels)

    def surface(self, surfels: Surfels, names: Sequence[str] = ()) -> Surface:
        """The mesh with present values of attributes of `surfels`, to look up where `closest` hits it. Raises
        InputError without `set_materials` for this mesh and number of surfels, or an attribute."""
        if self.vertex_surfels is None:
            remedy = "call Occluder.set_materials after update"
            raise InputError("none are set", "occluder", "materials", remedy)
        return Surface(self.vertex_surfels, surfels, names)

    def visible(
        self, origin: Point3f, direction: Vector3f, normal: Vector3f = None, active: Bool = True
    ) -> Float:
        """1 where the ray, of any length, leaves freely, is not `active` or not finite; 0 where it is
        blocked. It starts (world) OFFSET_VOXELS off the surface of this normal, or along itself without one:
        farther along the ray, up to ALONG offsets, and for what is missing along the normal."""
        if self.empty:
            return dr.full(mi.Float, 1, max(dr.width(origin), dr.width(direction)))
        with dr.suspend_grad():
            ray, valid = self._ray(origin, direction, normal)
            return dr.select(self._scene.ray_test(ray, valid & active), mi.Float(0), mi.Float(1))

    def closest(self, origin: Point3f, direction: Vector3f, normal: Vector3f, active: Bool = True) -> Hit:
        """First hits of the rays of `visible`; detached. The mesh must not be empty."""
        with dr.suspend_grad():
            ray, valid = self._ray(origin, direction, normal)
            hit = self._scene.ray_intersect_preliminary(ray, coherent=False, active=valid & active)
            stopped = hit.is_valid()
            # Embree leaves the fields of a miss undefined: they may be NaN.
            found = (dr.select(stopped, x, 0) for x in (hit.t, hit.prim_index, hit.prim_uv))
            distance, triangle, barycentric = found
            return Hit(stopped, ray(distance), triangle, barycentric)

    def first_hit(self, origin: Point3f, direction: Vector3f, active: Bool = True) -> tuple[Float, Bool]:
        """Distance to the mesh in lengths of `direction` (0 without a hit), and if it is hit; detached."""
        if self.empty:
            width = max(dr.width(origin), dr.width(direction))
            return dr.zeros(mi.Float, width), dr.zeros(mi.Bool, width)
        with dr.suspend_grad():
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
            hit = self._scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            valid = hit.is_valid()
            return dr.select(valid, hit.t, 0), valid

    def _ray(self, origin: Point3f, direction: Vector3f, normal: Vector3f) -> tuple[Any, Bool]:
        """The ray that starts off the surface, and whether it can be traced."""
        assert self.mesh is not None
        if self._variant != mi.variant():
            variants = f"under {self._variant}, not under {mi.variant()}"
            raise RuntimeError(f"Occluder was made {variants}: call update again")
        offset = OFFSET_VOXELS * dr.opaque(mi.Float, self.mesh.voxel)
        d, active = _unit(mi.Vector3f(direction))
        start = offset * d
        if normal is not None:
            n, has_normal = _unit(mi.Vector3f(normal))
            cosine = dr.dot(n, d)
            # The floor keeps the reciprocal finite; ALONG cuts it long before.
            along = dr.select(cosine > 0, offset * dr.minimum(dr.rcp(dr.maximum(cosine, 1e-3)), ALONG), 0)
            start = dr.select(has_normal, along * d + (offset - along * cosine) * n, start)
        o = mi.Vector3f(origin) + start
        active &= dr.all(dr.isfinite(o))
        return mi.Ray3f(mi.Point3f(dr.select(active, o, 0)), d), active


def _unit(v: Vector3f) -> tuple[Vector3f, Bool]:  # and whether there is one, else (0, 0, 0)
    squared = dr.squared_norm(v)
    valid = dr.isfinite(squared) & (squared > 0)
    return dr.select(valid, v * dr.select(valid, dr.rsqrt(dr.select(valid, squared, 1)), 0), 0), valid


def _values(mesh: Mesh) -> dict[str, Array]:
    """Parameters of a `mi.Mesh` by their name in `mi.traverse`: Mitsuba 3.10 renamed and reshaped them."""
    if hasattr(mi.Mesh, "vertex_positions_buffer"):
        return {"vertex_positions": upload(mesh.vertices), "faces": upload(mesh.faces, mi.UInt32)}
    return {"positions": upload_tensor(mesh.vertices), "faces": upload_tensor(mesh.faces, mi.TensorXu)}


def _mitsuba_mesh(name: str, mesh: Mesh) -> Any:
    """A `mi.Mesh` with flat shading normals and the winding as orientation; at least one face."""
    if not hasattr(mi.Mesh, "vertex_positions_buffer"):
        return mi.Mesh(name, **_values(mesh))
    made = mi.Mesh(name, len(mesh.vertices), len(mesh.faces))
    _set_mesh(mi.traverse(made), "", mesh)
    return made


def mesh_arrays(shape: Any) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) float64, world, and faces (F, 3) int64 of a mesh of a scene, by its PLY file: Mitsuba
    3.10 renamed the methods that return them."""
    stream = mi.MemoryStream()
    shape.write_ply(stream)
    mesh: Any = trimesh.load(io.BytesIO(stream.raw_buffer()), "ply", process=False)
    return np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)


def _set_mesh(params: Any, prefix: str, mesh: Mesh) -> None:
    """Replace a mesh in place, counts included, by its parameters (prefix "") or its scene's ("name.")."""
    for name, value in _values(mesh).items():
        params[prefix + name] = value
    params.update()
