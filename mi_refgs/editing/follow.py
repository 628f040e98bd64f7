"""The occluding mesh after an edit: each triangle belongs to the surfels around it and does as they do.

Extracted again from depth maps it would lose what no view sees, such as the contact of two objects, and
it needs the views. A triangle whose surfels are gone casts no shadow and is in no mirror; where an object is
cut the mesh is open, as the surfels are.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.editing.rigid import Placement
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import sigmoid

NEIGHBOURS = 8
"""Surfels around the middle of a triangle that decide about it: as many as give a vertex its materials."""
MAJORITY = 0.5
"""Share of their opacity."""


class Owners:
    """The surfels around each triangle of a scene's mesh: its own, then those of the surroundings."""

    def __init__(self, scene: TrainedScene) -> None:
        assert scene.mesh is not None
        mesh, tables = scene.mesh, [scene.surfels.to_numpy()]
        self.own = len(tables[0]["position"])
        if scene.surroundings is not None:
            tables.append(scene.surroundings.surfels.to_numpy())
        position = np.concatenate([table["position"] for table in tables])
        opacity = sigmoid(np.concatenate([table["opacity"] for table in tables])[:, 0])
        centre = mesh.vertices[mesh.faces].mean(axis=1)
        near = np.arange(1, min(NEIGHBOURS, len(position)) + 1)
        _, self.surfel = cKDTree(position).query(centre, k=near)
        self.opacity = opacity
        self.whole = np.maximum(opacity[self.surfel].sum(axis=1), np.finfo(np.float64).tiny)

    def share(self, opacity: np.ndarray) -> np.ndarray:
        """Part (F,) of the opacity around each triangle that is left by other opacities (N,) of its own."""
        padded = self.opacity.copy()
        padded[: self.own] = opacity
        return np.asarray(padded[self.surfel].sum(axis=1) / self.whole)

    def chosen(self, rows: np.ndarray) -> np.ndarray:
        """The triangles (F,) bool of chosen surfels (N,) bool of its own."""
        others = np.zeros_like(self.opacity)
        others[: self.own] = np.where(rows, self.opacity[: self.own], 0)
        return np.asarray(others[self.surfel].sum(axis=1) > MAJORITY * self.whole)


def without_surroundings(scene: TrainedScene) -> Mesh | None:
    """The triangles of the object's own surfels."""
    if scene.mesh is None or scene.surroundings is None or not len(scene.mesh.faces):
        return scene.mesh
    owners = Owners(scene)
    return scene.mesh.part(owners.chosen(np.ones(owners.own, bool)))


def placed(mesh: Mesh, placement: Placement) -> Mesh:
    """The mesh moved as a whole."""
    vertices = placement.points(mesh.vertices).astype(np.float32)
    return Mesh(vertices, mesh.faces, mesh.voxel * placement.factor)


def together(first: Mesh | None, second: Mesh | None) -> Mesh | None:
    """Both meshes as one, of the coarser one's voxel: rays start as far off the surface as that needs."""
    if first is None or second is None or not len(second.faces):
        return second if first is None else first
    if not len(first.faces):
        return second
    faces = np.concatenate([first.faces, second.faces + np.uint32(len(first.vertices))])
    vertices = np.concatenate([first.vertices, second.vertices])
    return Mesh(vertices, faces, max(first.voxel, second.voxel))
