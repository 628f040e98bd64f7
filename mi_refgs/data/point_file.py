"""Points of structure from motion in a PLY file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.readers import PointCloud
from mi_refgs.errors import InputError
from mi_refgs.io.files import require_file
from mi_refgs.io.images import linear_from_srgb
from mi_refgs.io.ply import read_vertices


def read_points(path: Path) -> PointCloud | None:
    """Points x, y, z with red, green, blue of 8 bits or 0 … 1, sRGB-encoded; None without any.

    Points without usable numbers are left out. Raises InputError for a file that is missing or unusable.
    """
    require_file(path)
    with path.open("rb") as file:
        vertices = read_vertices(path, file)
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"{path}: vertex: no x, y, z; export the points again")
    position = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=-1)
    usable = (np.abs(position) <= MAX_NUMBER).all(axis=1)
    if not usable.any():
        return None
    if not {"red", "green", "blue"} <= {*names}:
        return PointCloud(position[usable])
    colour = np.stack([vertices[name][usable] for name in ("red", "green", "blue")], axis=-1)
    largest = 1 if vertices.dtype["red"].kind == "f" and not (colour > 1).any() else 255
    colour = np.clip(np.nan_to_num(colour.astype(np.float32)) / largest, 0, 1)
    return PointCloud(position[usable], linear_from_srgb(colour))
