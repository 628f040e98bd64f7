"""The surface of an object for other programs: a mesh of so many triangles, unwrapped into a texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from mi_refgs.errors import SceneError
from mi_refgs.kernels.device import upload
from mi_refgs.occlusion.mesh import Mesh, clean
from mi_refgs.occlusion.visibility import Occluder

SMOOTHING = 30
"""Steps of Taubin's filter, which takes the steps of the voxels off a surface and keeps its volume. [Taubin
1995, "A Signal Processing Approach to Fair Surface Design"]"""
PADDING = 4
"""Texels between charts: two mip levels, or as many of bilinear lookup, see no other chart."""
FLAT = 1e-6
"""Voxel of the texture's plane as a mesh, of which rays of length 1 need next to nothing."""


@dataclass(frozen=True)
class Chart:
    """A mesh in a square texture. V vertices after it is cut open, F faces in the order of the mesh."""

    vertex: np.ndarray  # (V,) of the mesh
    faces: np.ndarray  # (F, 3) uint32
    uv: np.ndarray  # (V, 2) in 0 … 1, v upwards: the first row of a texture is at v = 1


def surface(mesh: Mesh, faces: int) -> Mesh:
    """The mesh without steps and floaters, of at most about `faces` triangles by quadric edge collapse.

    Raises InputError if there is nothing of it.
    """
    if not len(mesh.faces):
        raise SceneError("mesh: the run has none that textures could be baked to; train it for longer")
    low, size = mesh.vertices.min(axis=0), np.ptp(mesh.vertices, axis=0).max()
    made = trimesh.Trimesh((mesh.vertices - low) / size, mesh.faces, process=False)
    trimesh.smoothing.filter_taubin(made, iterations=SMOOTHING)
    if len(made.faces) > faces:
        made = made.simplify_quadric_decimation(face_count=faces)
    # In a unit box `open_` keeps every part that is large; without, a part that the box of an object has cut
    # open could count as the wall of a cavity.
    whole = clean(np.asarray(made.vertices), np.asarray(made.faces), mesh.voxel, open_=True)
    return Mesh((whole.vertices * size + low).astype(np.float32), whole.faces, mesh.voxel)


def unwrap(mesh: Mesh, size: int) -> Chart:
    """The mesh cut into charts that fill a texture of size² texels without overlap; some are mirrored."""
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(mesh.vertices, mesh.faces)
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = size, PADDING
    atlas.generate(xatlas.ChartOptions(), packing)
    vertex, faces, uv = atlas[0]
    return Chart(np.asarray(vertex), np.asarray(faces, np.uint32), np.clip(np.asarray(uv, np.float64), 0, 1))


def texels(chart: Chart, size: int) -> tuple[np.ndarray, Any, Any]:
    """The texels of a size² texture whose centre lies in a triangle.

    Returns which they are (size, size), the first row at v = 1, and for them, row by row, the triangle
    (mi.UInt32) and the barycentric coordinates of its second and third corner (mi.Point2f).
    """
    flat = np.concatenate([chart.uv, np.zeros((len(chart.uv), 1))], axis=1)
    plane = Occluder(Mesh(flat.astype(np.float32), chart.faces, FLAT))
    row, column = np.divmod(np.arange(size * size), size)
    above = mi.Point3f(upload((column + 0.5) / size), upload(1 - (row + 0.5) / size), mi.Float(1))
    hit = plane.closest(above, mi.Vector3f(0, 0, -1), None)
    covered = hit.valid.numpy()
    found = np.flatnonzero(covered)
    triangle = upload(hit.triangle.numpy()[found], mi.UInt32)
    barycentric = mi.Point2f(*(upload(x.numpy()[found]) for x in hit.barycentric))
    return covered.reshape(size, size), triangle, barycentric
