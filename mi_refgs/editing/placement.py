"""Similarity transforms of surfels and of the mesh that occludes them.

Each triangle follows the surfels around it. A mesh extracted again would lose what no view sees, such as the
contact of two objects, and would need the views. A triangle whose surfels are removed casts no shadow and
appears in no reflection; where an object is cut, its mesh is open, as the surfels are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.sh import sh_rotation
from mi_refgs.surfels.attributes import ATTRIBUTES, sigmoid
from mi_refgs.surfels.primitives import primitive_of
from mi_refgs.surfels.table import QUATERNION_FLOOR

NEIGHBOURS = 8
"""Surfels around the middle of a triangle that decide about it: as many as give a vertex its materials."""
MAJORITY = 0.5
"""Share of their opacity."""
TINY = np.finfo(np.float64).tiny


@dataclass(frozen=True, eq=False)
class Placement:
    """p → rotation (factor (p - pivot)) + pivot + shift; the rotation is proper, the factor positive."""

    pivot: np.ndarray  # (3,) float64, world
    shift: np.ndarray  # (3,) float64, scene units
    rotation: Rotation
    factor: float = 1.0

    @property
    def keeps_directions(self) -> bool:
        """Whether the rotation is the identity."""
        return bool(self.rotation.magnitude() == 0)

    @property
    def is_identity(self) -> bool:
        """Whether everything stays where it is."""
        return self.keeps_directions and self.factor == 1 and not self.shift.any()

    def points(self, points: np.ndarray) -> np.ndarray:
        """Transform world points (N, 3), float64."""
        offset = self.factor * (np.asarray(points, np.float64) - self.pivot)
        return (offset if self.keeps_directions else self.rotation.apply(offset)) + self.pivot + self.shift

    def surfels(self, raw: dict[str, np.ndarray]) -> None:
        """Transform raw attributes (N, D) in place; what does not change stays bit for bit."""
        if self.is_identity or not len(raw["position"]):
            return
        raw["position"][:] = self.points(raw["position"])
        if self.factor != 1:
            primitive_of(raw).resize(raw, np.ones(len(raw["position"]), bool), self.factor)
        if self.keeps_directions:
            return
        for name, table in raw.items():
            declared = ATTRIBUTES[name]
            if declared.activation == "quaternion":
                values = table.astype(np.float64)  # (x, y, z, w) of any norm; zeros are the identity
                values[np.abs(values).max(axis=1) < QUATERNION_FLOOR] = (0, 0, 0, 1)
                table[:] = (self.rotation * Rotation.from_quat(values)).as_quat()
            elif declared.harmonics:
                table[:] = rotated_sh(table, self.rotation)
            elif declared.direction:
                table[:] = self.rotation.apply(table.astype(np.float64))

    def mesh(self, mesh: Mesh) -> Mesh:
        """Transform a mesh and its voxel."""
        vertices = self.points(mesh.vertices).astype(np.float32)
        return Mesh(vertices, mesh.faces, mesh.voxel * self.factor)


def rotated_sh(
    raw: np.ndarray,  # (N, D), column = 3 coefficient + rgb
    rotation: Rotation,
) -> np.ndarray:
    """Return raw SH coefficients (N, D) of the rotated functions."""
    rows, width = raw.shape
    matrix = sh_rotation(rotation.as_matrix(), round((width // 3) ** 0.5) - 1)
    coefficients = raw.reshape(rows, width // 3, 3).astype(np.float64)
    return np.einsum("ij,njc->nic", matrix, coefficients).reshape(rows, width)


class Owners:
    """The surfels around each triangle of a scene's mesh: the object's, then those of the background."""

    def __init__(self, scene: TrainedScene) -> None:
        assert scene.mesh is not None
        models = (
            [scene.surfels] if scene.surroundings is None else [scene.surfels, scene.surroundings.surfels]
        )
        tables = [model.to_numpy() for model in models]
        self.count = len(tables[0]["position"])  # of the object
        position, opacity = (
            np.concatenate([table[name] for table in tables]) for name in ("position", "opacity")
        )
        near = np.arange(1, min(NEIGHBOURS, len(position)) + 1)
        _, self.surfel = cKDTree(position).query(scene.mesh.vertices[scene.mesh.faces].mean(axis=1), k=near)
        self.opacity = sigmoid(opacity[:, 0])
        self.total = np.maximum(self.opacity[self.surfel].sum(axis=1), TINY)

    def share(self, opacity: np.ndarray) -> np.ndarray:
        """Return the part (F,) of the opacity around each triangle that new opacities (N,) leave."""
        padded = np.concatenate([opacity, self.opacity[self.count :]])
        return np.asarray(padded[self.surfel].sum(axis=1) / self.total)

    def of(self, chosen: np.ndarray) -> np.ndarray:
        """Return the triangles (F,) bool of the chosen surfels (N,) bool of the object."""
        padded = np.where(np.pad(chosen, (0, len(self.opacity) - self.count)), self.opacity, 0)
        return np.asarray(padded[self.surfel].sum(axis=1) > MAJORITY * self.total)


def object_mesh(scene: TrainedScene) -> Mesh | None:
    """Return the triangles of the object's own surfels."""
    if scene.mesh is None or scene.surroundings is None or not len(scene.mesh.faces):
        return scene.mesh
    return scene.mesh.part(Owners(scene).of(np.ones(scene.surfels.count, bool)))


def joined_mesh(first: Mesh | None, second: Mesh | None) -> Mesh | None:
    """Return both meshes as one, with the larger voxel: ray offsets must suit the coarser one."""
    if first is None or second is None or not len(second.faces):
        return second if first is None else first
    if not len(first.faces):
        return second
    faces = np.concatenate([first.faces, second.faces + np.uint32(len(first.vertices))])
    return Mesh(np.concatenate([first.vertices, second.vertices]), faces, max(first.voxel, second.voxel))
