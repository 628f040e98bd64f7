"""Colours at the vertices of the occluding mesh, to look up where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import upload
from mi_refgs.occlusion.mesh import Mesh


@dataclass(frozen=True)
class VertexColours:
    """One colour a vertex, linear over each face; detached."""

    faces: Any  # mi.UInt32 (3 F)
    rows: Any  # mi.Float (3 V)

    @staticmethod
    def of(mesh: Mesh, colours: np.ndarray) -> VertexColours:
        """Colours (V, 3) of the vertices of a mesh."""
        return VertexColours(upload(mesh.faces.ravel(), mi.UInt32), upload(np.asarray(colours).ravel()))

    def at(self, triangle: Any, barycentric: Any, active: Any) -> Any:
        """mi.Color3f at the barycentric coordinates of the second and third corner; 0 where not `active`."""
        shares = (1 - barycentric.x - barycentric.y, barycentric.x, barycentric.y)
        colour = mi.Color3f(0)
        for corner, share in enumerate(shares):
            vertex = dr.gather(mi.UInt32, self.faces, 3 * triangle + corner, active)
            colour += share * dr.gather(mi.Color3f, self.rows, vertex, active)
        return colour

    def numpy(self) -> np.ndarray:
        """The colours (V, 3)."""
        return np.array(self.rows).reshape(-1, 3)
