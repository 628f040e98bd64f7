"""Triangles that belong to surfels: a new mesh would need views, and lose what none sees."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import sigmoid

NEIGHBOURS = 8  # surfels around the middle of a triangle that decide about it
MAJORITY = 0.5  # share of their opacity


class Owners:
    """The surfels around each triangle of a scene's mesh: the object's, then those of the background."""

    def __init__(self, scene: TrainedScene) -> None:
        assert scene.mesh is not None
        tables = [scene.surfels.to_numpy()]
        if scene.surroundings is not None:
            tables.append(scene.surroundings.surfels.to_numpy())
        self.count = len(tables[0]["position"])  # of the object
        position, opacity = (
            np.concatenate([table[name] for table in tables]) for name in ("position", "opacity")
        )
        near = np.arange(1, min(NEIGHBOURS, len(position)) + 1)
        _, self.surfel = cKDTree(position).query(scene.mesh.vertices[scene.mesh.faces].mean(axis=1), k=near)
        self.opacity = sigmoid(opacity[:, 0])
        self.total = np.maximum(self.opacity[self.surfel].sum(axis=1), np.finfo(float).tiny)

    def share(self, opacity: np.ndarray) -> np.ndarray:
        """Return the part (F,) of the opacity around each triangle that new opacities (N,) leave."""
        padded = np.concatenate([opacity, self.opacity[self.count :]])
        return np.asarray(padded[self.surfel].sum(axis=1) / self.total)

    def of(self, chosen: np.ndarray) -> np.ndarray:
        """Return the triangles (F,) bool of the chosen surfels (N,) bool of the object."""
        padded = np.where(np.pad(chosen, (0, len(self.opacity) - self.count)), self.opacity, 0)
        return np.asarray(padded[self.surfel].sum(axis=1) > MAJORITY * self.total)
