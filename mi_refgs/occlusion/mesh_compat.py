"""Every touch of `mi.Mesh`'s data: Mitsuba 3.10 renamed and reshaped what 3.9 has."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np

from mi_refgs.kernels.device import upload, upload_tensor


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
