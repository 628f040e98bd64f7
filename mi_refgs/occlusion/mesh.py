"""A signed distance field's surface as a clean triangle mesh, and its PLY file."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from skimage import measure

from mi_refgs.errors import InputError, within
from mi_refgs.io.files import is_file, write_bytes
from mi_refgs.io.ply import Header, read_header
from mi_refgs.occlusion.tsdf import TSDF

COMPONENT_KEEP = 0.1  # area, relative to the largest component's, of an object rather than a floater
ZERO_NUDGE = 1e-3  # least |distance| (truncations): corners on the surface make triangles without area
FOREIGN_RESOLUTION = 256  # voxels along the diagonal of a mesh made elsewhere, about those of a fit
FORMATS = ("ply", "obj", "stl", "off")  # file endings that `read_mesh` accepts
VOXEL_COMMENT = "voxel_size"  # key of the PLY comment with the voxel size of the extraction


@dataclass(frozen=True)
class Mesh:
    """Triangles whose (v1 - v0) × (v2 - v0) points outward; a mesh without faces occludes nothing."""

    vertices: np.ndarray  # (V, 3) float32, world
    faces: np.ndarray  # (F, 3) uint32
    voxel: float  # resolution of the surface, scene units; offsets of visibility rays scale with it

    def __post_init__(self) -> None:
        """Raise InputError for values that are not finite, and faces without a vertex."""
        with np.errstate(over="ignore"):
            for name, kind in (("vertices", np.float32), ("faces", np.uint32)):
                object.__setattr__(self, name, np.asarray(getattr(self, name), kind))
        if not (0 < self.voxel < np.inf and np.isfinite(self.vertices).all()):
            wrong = f"vertices not finite, or {VOXEL_COMMENT} not above 0"
            raise InputError(wrong, "mesh", remedy="extract the mesh again")
        if self.faces.max(initial=0) >= max(len(self.vertices), 1):
            raise InputError("a face names a vertex that is not there", "mesh", remedy="write it again")

    @staticmethod
    def empty(voxel: float = 1.0) -> "Mesh":
        """The mesh of an empty volume."""
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3)), voxel)

    def part(self, kept: np.ndarray) -> "Mesh":
        """The kept triangles (F,) bool, with the vertices that they have."""
        used, faces = np.unique(self.faces[kept], return_inverse=True)
        return Mesh(self.vertices[used], faces.reshape(-1, 3), self.voxel)

    def normals(self) -> np.ndarray:
        """Outward unit normals (V, 3) of the triangles around each vertex."""
        # In voxels: trimesh takes triangles of less than 1e-14 square units for points.
        scaled = (self.vertices - self.vertices[0]) / self.voxel
        return np.asarray(trimesh.Trimesh(scaled, self.faces, process=False).vertex_normals)

    def of_vertices(self, kept: np.ndarray) -> "Mesh":
        """The triangles all of whose vertices are kept (V,) bool."""
        return self.part(kept[self.faces].all(axis=1))


def extract_mesh(tsdf: TSDF) -> Mesh:
    """Zero level set of the field by marching cubes (Lewiner et al. 2003), detached: closed by a cap at the
    border, without degenerate triangles and components below COMPONENT_KEEP of the largest one's area."""
    # One layer of free space all around closes surfaces that the box cuts.
    volume = np.pad(np.asarray(tsdf.volume, dtype=np.float32), 1, constant_values=1.0)
    volume = np.where(np.abs(volume) < ZERO_NUDGE, np.copysign(np.float32(ZERO_NUDGE), volume), volume)
    if not volume.min() < 0:
        return Mesh.empty(tsdf.voxel)
    # "descent": the field falls towards the object, and faces then wind outward.
    grid, faces, _, _ = measure.marching_cubes(volume, 0.0, gradient_direction="descent")
    return clean(np.asarray(tsdf.origin) + (grid.astype(np.float64) - 1) * tsdf.voxel, faces, tsdf.voxel)


def clean(vertices: np.ndarray, faces: np.ndarray, voxel: float, open_: bool = False) -> Mesh:
    """The large components (without `open_` closed ones that wind outward), without degenerate triangles."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.update_faces(mesh.area_faces > 0)
    if not len(mesh.faces):
        return Mesh.empty(voxel)
    label = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    area = np.bincount(label, weights=mesh.area_faces)
    corners = mesh.triangles - mesh.vertices.mean(axis=0)
    solid = (np.bincount(label, weights=np.linalg.det(corners)) > 0) | open_
    keep = (area >= COMPONENT_KEEP * area[solid].max(initial=0)) & solid
    mesh.update_faces(keep[label])
    mesh.remove_unreferenced_vertices()
    return Mesh(mesh.vertices, mesh.faces, voxel)


def write_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write a binary PLY, voxel size in a comment, atomically; raises InputError if that fails."""
    data: Any = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(file_type="ply")
    first, second, rest = data.split(b"\n", 2)
    comment = f"comment {VOXEL_COMMENT} {float(mesh.voxel)!r}".encode()
    write_bytes(path, b"\n".join((first, second, comment, rest)))


def read_mesh(path: Path | str) -> Mesh:
    """Read a triangle mesh (PLY, OBJ, STL, OFF), and no file that it refers to; its voxel size is in the
    comment of `write_mesh`, else see FOREIGN_RESOLUTION. Raises InputError."""
    path = Path(path)
    if not is_file(path):
        raise InputError("no such file", path, "mesh", "give the mesh.ply of a run")
    kind = path.suffix.lower().removeprefix(".")
    if kind not in FORMATS:
        raise InputError(f"not one of {', '.join(FORMATS)}", path, "mesh", "write it again as PLY or OBJ")
    try:
        with path.open("rb") as file:
            header = read_header(path, file) if kind == "ply" else Header("", (), ())
            file.seek(0)
            data = io.BytesIO(file.read())  # in memory: no other file is resolved beside it
        noted = [words for words in map(str.split, header.comments) if words[:1] == [VOXEL_COMMENT]]
        voxel = float(noted[0][1]) if noted else None
        if any(element.name == "face" and not element.count for element in header.elements):
            return Mesh.empty(1.0 if voxel is None else voxel)
        options: Any = {"skip_materials": True} if kind in ("ply", "obj") else {}
        mesh: Any = trimesh.load(data, kind, force="mesh", process=False, **options)
        if voxel is None:
            voxel = float(np.linalg.norm(mesh.extents)) / FOREIGN_RESOLUTION if len(mesh.faces) else 1.0
    except InputError:
        raise
    except Exception as error:  # trimesh raises whatever its parsers meet
        raise InputError("not a readable triangle mesh", path, "mesh", "write it as PLY or OBJ") from error
    with within(path):
        return Mesh(mesh.vertices, mesh.faces, voxel)
