"""One bit per ray: does the extracted mesh stand in its way?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload, upload_tensor
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.surface_materials import Surface, VertexColours, VertexSurfels
from mi_refgs.surfels.table import Surfels


def _is_3_9() -> bool:
    return hasattr(mi.Mesh, "vertex_positions_buffer")


def mesh_values(vertices: np.ndarray, faces: np.ndarray) -> dict[str, Any]:
    """Parameters of a `mi.Mesh` (by `mi.traverse` name) for (V, 3) world vertices and (F, 3) indices."""
    if _is_3_9():
        return {"vertex_positions": upload(vertices), "faces": upload(faces, mi.UInt32)}
    return {"positions": upload_tensor(vertices), "faces": upload_tensor(faces, mi.TensorXu)}


def make_mesh(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A `mi.Mesh` with flat shading normals; its winding is its orientation. At least one face."""
    values = mesh_values(vertices, faces)
    if not _is_3_9():
        return mi.Mesh(name, **values)
    mesh = mi.Mesh(name, len(vertices), len(faces))
    update_mesh(mi.traverse(mesh), "", vertices, faces)
    return mesh


def update_mesh(params: Any, prefix: str, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Replace a mesh in place, counts included, through the parameters of it (prefix "") or its scene
    ("name.")."""
    for name, value in mesh_values(vertices, faces).items():
        params[prefix + name] = value
    params.update()


OFFSET_VOXELS = 2.0
"""Voxels by which a ray's origin leaves the surface along the normal. What it must cover: the mesh's own
error (0.4 voxel measured on smooth shapes) and that of the expected depth. Measured on five shapes with
points 1 voxel too deep and normals off by 6°: a quarter of all rays is falsely occluded at 1 voxel, 0.1 % at
1.5 and at 2, and what a larger offset loses, contacts, is as small (0.6 % of the rays at 2 voxels where
points float 0.5 voxel above the surface). Along the ray instead, a grazing ray gains no height: 2 voxels,
points half a voxel too deep, leave 94 % of them occluded."""


@dataclass(frozen=True)
class Hit:
    """Where rays meet the mesh first, detached."""

    valid: Any  # mi.Bool: something is hit
    point: Any  # mi.Point3f, world
    triangle: Any  # mi.UInt32
    barycentric: Any  # mi.Point2f on it: barycentric coordinates of its second and third corner


class Occluder:
    """The extracted mesh in a private scene of its own, updated in place.

    It is not part of the user's scene: that scene's geometry must neither be hit here nor be hidden by this
    mesh. What `visible` returned must be evaluated before the next `update`: Dr.Jit traces rays
    when their result is needed.
    """

    NAME = "occluder"

    def __init__(self, mesh: Mesh | None = None) -> None:
        self._mesh: Mesh | None = None
        self._scene: Any = None
        self._params: Any = None
        self._variant: str | None = None
        self.vertex_surfels: VertexSurfels | None = (
            None  # of this mesh; None also where rows of the table have moved
        )
        self.ambient: VertexColours | None = None  # share of diffuse light that arrives, of this mesh
        if mesh is not None:
            self.update(mesh)

    def mesh(self) -> Mesh | None:
        """The present mesh, for checkpoints; None before the first `update`."""
        return self._mesh

    def update(self, mesh: Mesh) -> None:
        """Replace the mesh. Vertex and face counts may change, to zero too; compiled kernels stay valid."""
        self._mesh, self.vertex_surfels, self.ambient = mesh, None, None
        if not len(mesh.faces):
            return
        if self._scene is None or self._variant != mi.variant():
            self._variant = mi.variant()
            shape = make_mesh(self.NAME, mesh.vertices, mesh.faces)
            self._scene = mi.load_dict({"type": "scene", self.NAME: shape})
            self._params = mi.traverse(self._scene)
        else:
            update_mesh(self._params, f"{self.NAME}.", mesh.vertices, mesh.faces)

    @property
    def empty(self) -> bool:
        """Whether there is nothing that a ray could hit."""
        return self._mesh is None or not len(self._mesh.faces)

    def set_materials(self, surfels: Surfels) -> None:
        """Give every vertex the surfels around it, whose materials `surface` then reads, under AD.

        To be called again after `update`, and whenever surfels move or their number changes; new values of
        their materials need no call. Raises InputError without surfels or without their material channels.
        """
        self.vertex_surfels = None
        if self._mesh is not None and not self.empty:
            self.vertex_surfels = VertexSurfels.of(self._mesh, surfels)

    def surface(self, surfels: Surfels) -> Surface:
        """The mesh with the present materials of `surfels`, to look up where `closest` hits it.

        Raises InputError without a `set_materials` for this mesh and this number of surfels.
        """
        if self.vertex_surfels is None:
            raise InputError("occluder: materials: none are set; call Occluder.set_materials after update")
        return self.vertex_surfels.surface(surfels)

    def visible(self, origin: Any, direction: Any, normal: Any = None, active: Any = True) -> Any:
        """1 where the ray leaves the scene freely, 0 where the mesh stops it.

        `origin` (mi.Point3f) is in world space; `direction` and `normal` need not be unit. The origin first
        moves OFFSET_VOXELS off the surface along the normal; without one (or where it is zero) along the ray,
        which is right for steep rays only. There is no distance threshold. Rays without a finite direction,
        those that are not `active`, and all rays while there is no mesh, are visible. Detached: visibility
        has no derivative."""
        width = max(dr.width(origin), dr.width(direction))
        if self.empty:
            return dr.full(mi.Float, 1, width)
        with dr.suspend_grad():
            ray, valid = self._ray(origin, direction, normal)
            return dr.select(self._scene.ray_test(ray, valid & active), mi.Float(0), mi.Float(1))

    def closest(self, origin: Any, direction: Any, normal: Any, active: Any = True) -> Hit:
        """What the rays of `visible` hit first; detached. The mesh must not be empty."""
        with dr.suspend_grad():
            ray, valid = self._ray(origin, direction, normal)
            hit = self._scene.ray_intersect_preliminary(ray, coherent=False, active=valid & active)
            stopped = hit.is_valid()
            # Embree leaves the fields of a miss undefined: they may be NaN.
            distance, triangle, barycentric = (
                dr.select(stopped, x, 0) for x in (hit.t, hit.prim_index, hit.prim_uv)
            )
            return Hit(stopped, ray(distance), triangle, barycentric)

    def first_hit(self, origin: Any, direction: Any, active: Any = True) -> tuple[Any, Any]:
        """Distance to the mesh in lengths of `direction` (0 without a hit), and if it is hit; detached."""
        width = max(dr.width(origin), dr.width(direction))
        if self.empty:
            return dr.zeros(mi.Float, width), dr.zeros(mi.Bool, width)
        with dr.suspend_grad():
            ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(direction))
            hit = self._scene.ray_intersect_preliminary(ray, coherent=True, active=active)
            valid = hit.is_valid()
            return dr.select(valid, hit.t, 0), valid

    def _ray(self, origin: Any, direction: Any, normal: Any) -> tuple[Any, Any]:
        """The ray that starts off the surface, and whether it can be traced."""
        assert self._mesh is not None
        if self._variant != mi.variant():
            raise RuntimeError(
                f"Occluder was made under {self._variant}, not under {mi.variant()}: call update again"
            )
        offset = OFFSET_VOXELS * dr.opaque(mi.Float, self._mesh.voxel)
        d, active = _unit(mi.Vector3f(direction))
        away = d
        if normal is not None:
            n, has_normal = _unit(mi.Vector3f(normal))
            away = dr.select(has_normal, n, d)
        o = mi.Vector3f(origin) + offset * away
        active &= dr.all(dr.isfinite(o))
        return mi.Ray3f(mi.Point3f(dr.select(active, o, 0)), d), active


def _unit(v: Any) -> tuple[Any, Any]:
    """Unit vector and whether there is one; (0, 0, 0) where there is none."""
    squared = dr.squared_norm(v)
    valid = dr.isfinite(squared) & (squared > 0)
    scale = dr.select(valid, dr.rsqrt(dr.select(valid, squared, 1)), 0)
    return dr.select(valid, v * scale, 0), valid
