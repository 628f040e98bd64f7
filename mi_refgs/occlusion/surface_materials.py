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
from mi_refgs.types import Array, Bool, Color3f, Float, Point2f, Point3f, UInt32, Vector3f

NEIGHBOURS = 4  # surfels per vertex: those that overlap at a point of a fitted surface with visible weight
NORMALS = 16  # surfels per vertex of which its normal is the mean: 1.3° off on `mirror_ring`, of 4 1.9°
WEIGHT_FLOOR = 1e-6  # sum of weights below which a vertex takes the nearest surfel only
NORMAL_AGREEMENT = 0.5  # cosine to the mesh's normal from which a neighbour's is used
GRAZING = 0.1  # cosine of a ray to a triangle from which its hit has derivatives: below, it moves too far
GROUP = 4  # columns that one access reads


@dataclass(frozen=True)
class SurfaceSample:
    """The surface where N rays meet it."""

    values: dict[str, Array]  # attributes by name, interpolated: mi.Float, mi.Color3f or a list of columns
    normal: Vector3f  # interpolated, outward, not unit
    surfel: UInt32  # the surfel nearest to the nearest vertex


class VertexSurfels:
    """The surfels around every vertex of a mesh: V vertices, K neighbours, F faces."""

    def __init__(self, mesh: Mesh, count: int, arrays: Mapping[str, np.ndarray]) -> None:
        """The neighbours among `count` surfels from their `arrays`."""
        self.count, self.faces = count, upload(mesh.faces.ravel(), mi.UInt32)  # (3 F,)
        self.surfel = [upload(row, mi.UInt32) for row in arrays["surfels"]]  # K × (V,), the nearest first
        # K × (V,): the sum of magnitudes is 1; negative if a surfel's normal points inwards.
        self.weight = [upload(row) for row in arrays["weights"]]
        self.rest = mi.Vector3f(*(upload(row) for row in arrays["normals"]))  # (V,) see `normals`
        self.corners = upload(mesh.vertices.ravel())  # (3 V,) world

    @staticmethod
    def of(mesh: Mesh, surfels: Surfels) -> "VertexSurfels":
        """Find the NEIGHBOURS nearest surfels of each vertex, weighted by opacity and footprint, wider by a
        voxel along the normal; its normal is that of NORMALS surfels. Detached. Raises InputError without."""
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
        count = min(NORMALS, len(usable))
        _, found = cKDTree(position[usable]).query(mesh.vertices, k=np.arange(1, count + 1))
        found = usable[found]
        offset = mesh.vertices[:, None] - position[found]
        along = np.einsum("vkc,vkac->vka", offset, axes[found])
        beside = offset - np.einsum("vka,vkac->vkc", along, axes[found])
        reach = np.square(along / spread[found]).sum(-1) + np.square(beside / mesh.voxel).sum(-1)
        weight = opacity[found] * np.exp(-0.5 * reach)

        # Normals as they vary over the surfels.
        turned = normal[found]
        for i, turn in enumerate(surfels.primitive.turns(surfels, mi.Vector3f(normal.T)).values()):
            turned = turned + (along[..., i] / spread[found][..., i])[..., None] * turn.numpy().T[found]
        mean = _normals(mesh, turned, weight)

        # Materials of the nearest alone: textures stay sharp.
        found, weight = found[:, :NEIGHBOURS], weight[:, :NEIGHBOURS]
        total = weight.sum(1, keepdims=True)
        nearest = np.arange(found.shape[1]) == 0
        weight = np.where(total > WEIGHT_FLOOR, weight / np.maximum(total, WEIGHT_FLOOR), nearest)
        weight = np.where(np.einsum("vkc,vc->vk", normal[found], mean) < 0, -weight, weight)
        rest = mean - np.einsum("vk,vkc->vc", weight, normal[found])
        arrays = {"surfels": found.T, "weights": weight.T, "normals": rest.T}
        return VertexSurfels(mesh, surfels.count, arrays)

    def arrays(self) -> dict[str, np.ndarray]:
        """Values for checkpoints: "surfels" and "weights" (K, V), "normals" (3, V)."""
        surfel, weight = (np.array([np.array(x) for x in columns]) for columns in (self.surfel, self.weight))
        return {"surfels": surfel, "weights": weight, "normals": np.array(self.rest)}

    def normals(self, surfels: Surfels) -> Vector3f:
        """Present outward normals at the vertices (V,), under AD: unit when the surfels were found, they turn
        as those of the nearest since."""
        own, found = surfels.primitive.normal(surfels), self.rest
        for surfel, weight in zip(self.surfel, self.weight, strict=True):
            found = found + weight * dr.gather(mi.Vector3f, own, surfel)
        return found

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
                    mixed[i] += dr.abs(weight) * dr.gather(mi.Float, column, surfel)
        return found


class Surface:
    """A mesh with present values of attributes of surfels, to look up at hits."""

    def __init__(self, vertex_surfels: VertexSurfels, surfels: Surfels, names: Sequence[str]) -> None:
        values = vertex_surfels.values(surfels, names)
        columns = [column for own in values.values() for column in own] + [*vertex_surfels.normals(surfels)]
        columns += [mi.Float(0)] * (-len(columns) % GROUP)
        self.vertex_surfels = vertex_surfels
        self.rows = dr.ravel(mi.ArrayXf(columns))  # by vertices
        self.widths = {name: len(own) for name, own in values.items()}  # columns of each attribute

    def at(self, triangle: UInt32, barycentric: Point2f, active: Bool) -> SurfaceSample:
        """Attributes at barycentric coordinates of the second and third corner."""
        groups = -(-(sum(self.widths.values()) + 3) // GROUP)  # of a vertex
        mixed = [mi.Vector4f(0) for _ in range(groups)]
        closest, largest = mi.UInt32(0), mi.Float(-1)
        for vertex, share in corners_of(self.vertex_surfels.faces, triangle, barycentric, active):
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

    def followed(
        self, triangle: UInt32, barycentric: Point2f, origin: Point3f, direction: Vector3f, active: Bool
    ) -> Point2f:
        """Barycentric coordinates of hits, with derivatives by the directions of their rays (not of those at
        GRAZING angles): where these meet the planes of the triangles."""
        known = self.vertex_surfels
        corners = corners_of(known.faces, triangle, barycentric, active)
        a, b, c = (dr.gather(mi.Point3f, known.corners, vertex, active) for vertex, _ in corners)
        along, beside = b - a, c - a
        normal = dr.cross(along, beside)
        slope, area2 = dr.dot(direction, normal), dr.squared_norm(normal)
        steep = dr.abs(dr.detach(slope)) > GRAZING * dr.sqrt(area2)
        point = origin + direction * (dr.dot(a - origin, normal) / dr.select(steep, slope, 1))
        offset = dr.select(steep, (point - a) / dr.select(steep, area2, 1), 0)
        uv = mi.Point2f(dr.dot(normal, dr.cross(offset, beside)), dr.dot(normal, dr.cross(along, offset)))
        return dr.replace_grad(mi.Point2f(barycentric), uv)


class VertexColours:
    """One colour per vertex, linear over each face; detached."""

    def __init__(self, mesh: Mesh, colours: np.ndarray) -> None:
        """Colours (V, 3) of the vertices of a mesh."""
        self.faces, self.rows = upload(mesh.faces.ravel(), mi.UInt32), upload(np.asarray(colours).ravel())

    def at(self, triangle: UInt32, barycentric: Point2f, active: Bool) -> Color3f:
        """Colour at barycentric coordinates of the second and third corner; 0 where not `active`."""
        colour = mi.Color3f(0)
        for vertex, share in corners_of(self.faces, triangle, barycentric, active):
            colour += share * dr.gather(mi.Color3f, self.rows, vertex, active)
        return colour

    def numpy(self) -> np.ndarray:
        return np.array(self.rows).reshape(-1, 3)


def corners_of(
    faces: UInt32, triangle: UInt32, barycentric: Point2f, active: Bool
) -> list[tuple[UInt32, Float]]:
    """Vertex and barycentric weight of each of the three corners of triangles (N,)."""
    shares = (1 - barycentric.x - barycentric.y, barycentric.x, barycentric.y)
    index = (3 * triangle + corner for corner in range(3))
    return [(dr.gather(mi.UInt32, faces, i, active), share) for i, share in zip(index, shares, strict=True)]


def _normals(mesh: Mesh, neighbours: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Outward unit normals (V, 3): weighted ones (V, K, 3) of the surfels that agree with the mesh's."""
    own = mesh.normals()
    cosine = np.einsum("vkc,vc->vk", neighbours, own)
    agrees = np.abs(cosine) > NORMAL_AGREEMENT * np.linalg.norm(neighbours, axis=2)
    mean = np.einsum("vk,vkc->vc", weight * agrees * np.sign(cosine), neighbours)
    length = np.linalg.norm(mean, axis=1, keepdims=True)
    return np.where(length > 0, mean / np.where(length > 0, length, 1), own)
