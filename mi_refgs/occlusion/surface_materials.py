"""Materials on the extracted mesh, under AD: of the surfels around each vertex, found once per mesh."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.surfels.table import Surfels, vector_of
from mi_refgs.types import Array, Bool, Color3f, Float, Point2f, UInt32, Vector3f

NEIGHBOURS = 4  # surfels per vertex: those that overlap at a point of a fitted surface with visible weight
WEIGHT_FLOOR = 1e-6  # sum of weights below which a vertex takes the nearest surfel only
NORMAL_AGREEMENT = 0.5  # cosine to the mesh's normal from which the neighbours' is used
GROUP = 4  # columns that one access reads


@dataclass(frozen=True)
class SurfaceSample:
    """The surface where N rays meet it; the normal is detached."""

    values: dict[str, Array]  # attributes by name, interpolated: mi.Float, mi.Color3f or a list of columns
    normal: Vector3f  # interpolated, outward, not unit
    surfel: UInt32  # the surfel nearest to the nearest vertex


class VertexSurfels:
    """The surfels around every vertex of a mesh: V vertices, K neighbours, F faces."""

    def __init__(self, mesh: Mesh, count: int, arrays: Mapping[str, np.ndarray]) -> None:
        """The neighbours among `count` surfels from their `arrays`."""
        self.count, self.faces = count, upload(mesh.faces.ravel(), mi.UInt32)  # (3 F,)
        self.surfel = [upload(row, mi.UInt32) for row in arrays["surfels"]]  # K × (V,), the nearest first
        self.weight = [upload(row) for row in arrays["weights"]]  # K × (V,), their sum is 1
        self.normal = mi.Vector3f(*(upload(row) for row in arrays["normals"]))  # (V,)

    @staticmethod
    def of(mesh: Mesh, surfels: Surfels) -> "VertexSurfels":
        """Find the NEIGHBOURS nearest surfels of each vertex, weighted by opacity and footprint, which is
        wider by a voxel along the normal. Detached. Raises InputError without surfels."""
        if not surfels.count:
            raise InputError("there are none to take materials from", "occluder", "surfels")
        usable, surfels = np.flatnonzero(surfels.usable().numpy()), surfels.detach().cleaned()
        if not len(usable):
            remedy = "correct them, or trace nothing"
            raise InputError("none has finite values", "occluder", "surfels", remedy)
        # Ellipsoids of the surfels: axes and standard deviations, along the normal at least a voxel.
        position, opacity = surfels.position().numpy().T, surfels.opacity().numpy()
        axes, spread = surfels.primitive.extent(surfels.to_numpy())
        normal = surfels.primitive.normal(surfels).numpy().T
        across = np.abs(np.sum(axes * normal[:, None], axis=2)) > 0.5
        spread = np.where(across, np.hypot(spread, mesh.voxel), spread)

        # Nearest surfels of each vertex, and their Gaussians there.
        count = min(NEIGHBOURS, len(usable))
        _, found = cKDTree(position[usable]).query(mesh.vertices, k=np.arange(1, count + 1))
        found = usable[found]
        offset = mesh.vertices[:, None] - position[found]
        along = np.einsum("vkc,vkac->vka", offset, axes[found])
        beside = offset - np.einsum("vka,vkac->vkc", along, axes[found])
        reach = np.square(along / spread[found]).sum(-1) + np.square(beside / mesh.voxel).sum(-1)
        weight = opacity[found] * np.exp(-0.5 * reach)
        total = weight.sum(1, keepdims=True)
        nearest = np.arange(count) == 0
        weight = np.where(total > WEIGHT_FLOOR, weight / np.maximum(total, WEIGHT_FLOOR), nearest)
        normal = _normals(mesh, normal[found], weight)
        arrays = {"surfels": found.T, "weights": weight.T, "normals": normal.T}
        return VertexSurfels(mesh, surfels.count, arrays)

    def arrays(self) -> dict[str, np.ndarray]:
        """Values for checkpoints: "surfels" and "weights" (K, V), "normals" (3, V)."""
        surfel, weight = (np.array([np.array(x) for x in columns]) for columns in (self.surfel, self.weight))
        return {"surfels": surfel, "weights": weight, "normals": np.array(self.normal)}

    def values(self, surfels: Surfels, names: Sequence[str]) -> dict[str, list[Float]]:
        """Present values at the vertices, by attribute: columns (V,), under AD; raises InputError."""
        for name in names:
            if not surfels.has(name):
                remedy = "add it, or trace nothing"
                raise InputError("surfels have no such attribute", "occluder", name, remedy)
        if surfels.count != self.count:
            numbers = f"there are {surfels.count}, but the mesh was given {self.count}"
            raise InputError(numbers, "occluder", "surfels", "call Occluder.set_materials after each change")
        found = {}
        for name in names:
            value = surfels.value(name)
            columns = [value] if surfels.raw[name].shape[1] == 1 else [*value]
            mixed = found[name] = [mi.Float(0) for _ in columns]
            for surfel, weight in zip(self.surfel, self.weight, strict=True):
                for i, column in enumerate(columns):
                    mixed[i] += weight * dr.gather(mi.Float, column, surfel)
        return found


class Surface:
    """A mesh with present values of attributes of surfels, to look up at hits."""

    def __init__(self, vertex_surfels: VertexSurfels, surfels: Surfels, names: Sequence[str]) -> None:
        values = vertex_surfels.values(surfels, names)
        columns = [column for own in values.values() for column in own] + [*vertex_surfels.normal]
        columns += [mi.Float(0)] * (-len(columns) % GROUP)
        self.vertex_surfels = vertex_surfels
        self.rows = dr.ravel(mi.ArrayXf(columns))  # by vertices
        self.widths = {name: len(own) for name, own in values.items()}  # columns of each attribute

    def at(self, triangle: UInt32, barycentric: Point2f, active: Bool) -> SurfaceSample:
        """Attributes at barycentric coordinates of the second and third corner."""
        groups = -(-(sum(self.widths.values()) + 3) // GROUP)  # of a vertex
        mixed = [mi.Vector4f(0) for _ in range(groups)]
        closest, largest = mi.UInt32(0), mi.Float(-1)
        for vertex, share in _corners(self.vertex_surfels.faces, triangle, barycentric, active):
            for i in range(groups):
                mixed[i] += share * dr.gather(mi.Vector4f, self.rows, groups * vertex + i, active)
            closest = dr.select(share > largest, vertex, closest)
            largest = dr.maximum(share, largest)
        surfel = dr.gather(mi.UInt32, self.vertex_surfels.surfel[0], closest, active)
        columns = (column for group in mixed for column in group)
        values = {}
        for name, width in self.widths.items():
            own = [next(columns) for _ in range(width)]
            values[name] = vector_of(own) if width <= 4 else own  # coefficients of SH
        return SurfaceSample(values, mi.Vector3f(*(next(columns) for _ in range(3))), surfel)


class VertexColours:
    """One colour per vertex, linear over each face; detached."""

    def __init__(self, mesh: Mesh, colours: np.ndarray) -> None:
        """Colours (V, 3) of the vertices of a mesh."""
        self.faces, self.rows = upload(mesh.faces.ravel(), mi.UInt32), upload(np.asarray(colours).ravel())

    def at(self, triangle: UInt32, barycentric: Point2f, active: Bool) -> Color3f:
        """Colour at barycentric coordinates of the second and third corner; 0 where not `active`."""
        colour = mi.Color3f(0)
        for vertex, share in _corners(self.faces, triangle, barycentric, active):
            colour += share * dr.gather(mi.Color3f, self.rows, vertex, active)
        return colour

    def numpy(self) -> np.ndarray:
        return np.array(self.rows).reshape(-1, 3)


def _corners(
    faces: UInt32, triangle: UInt32, barycentric: Point2f, active: Bool
) -> list[tuple[UInt32, Float]]:
    """Vertex and barycentric weight of each of the three corners of triangles (N,)."""
    shares = (1 - barycentric.x - barycentric.y, barycentric.x, barycentric.y)
    index = (3 * triangle + corner for corner in range(3))
    return [(dr.gather(mi.UInt32, faces, i, active), share) for i, share in zip(index, shares, strict=True)]


def _normals(mesh: Mesh, neighbours: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Outward unit normals (V, 3): weighted ones (V, K, 3) of the surfels where the mesh's agree."""
    own = mesh.normals()
    outward = np.where((neighbours * own[:, None]).sum(-1) < 0, -1.0, 1.0)
    mean = (neighbours * (weight * outward)[..., None]).sum(1)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    return np.where((mean * own).sum(1, keepdims=True) > NORMAL_AGREEMENT, mean, own)
