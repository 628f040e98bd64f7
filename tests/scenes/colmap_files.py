"""The files of a COLMAP model, as text and as binary records, for tests."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mi_refgs.data.colmap_model import MODELS


class ColmapCamera(NamedTuple):
    model: str
    size: tuple[int, int]  # width, height
    values: tuple[float, ...]


class ColmapImage(NamedTuple):
    name: str
    camera: int
    quaternion: Sequence[float]  # w, x, y, z
    translation: Sequence[float]


Model = tuple[Mapping[int, ColmapCamera], Sequence[ColmapImage], np.ndarray, np.ndarray]
"""Cameras by number, images, points (N, 3) and their colours (N, 3) of 8 bits."""


def colmap_text(model: Model) -> dict[str, bytes]:
    cameras, images, points, colours = model
    lines = ["# comment"]
    for number, camera in cameras.items():
        lines.append(" ".join(map(str, (number, camera.model, *camera.size, *camera.values))))
    poses = ["# Image list with two lines of data per image:"]
    for i, image in enumerate(images):
        pose = map(float, (*image.quaternion, *image.translation))
        poses.append(" ".join(map(str, (i + 1, *pose, image.camera, image.name))))
        poses.append("1.5 2.5 3 10.0 20.0 -1" if i % 2 else "")
    places = ["# points\n"]
    for i, (point, colour) in enumerate(zip(points.tolist(), colours.tolist(), strict=True)):
        places.append(" ".join(map(str, (i, *point, *colour, 0.5, 1, 0, 2, 0, 3, i))))
    contents = {"cameras": lines, "images": poses, "points3D": places}
    return {name: ("\n".join(found) + "\n").encode() for name, found in contents.items()}


def colmap_binary(model: Model) -> dict[str, bytes]:
    """The same contents in binary records."""
    cameras, images, points, colours = model
    found = {name: struct.pack("<Q", len(x)) for name, x in
             {"cameras": cameras, "images": images, "points3D": points}.items()}  # fmt: skip
    for number, camera in cameras.items():
        kind = MODELS[camera.model][0] if camera.model in MODELS else 7
        found["cameras"] += struct.pack("<iiQQ", number, kind, *camera.size)
        found["cameras"] += struct.pack(f"<{len(camera.values)}d", *camera.values)
    for i, image in enumerate(images):
        found["images"] += struct.pack("<i7di", i + 1, *image.quaternion, *image.translation, image.camera)
        found["images"] += image.name.encode() + b"\0"
        seen = struct.pack("<Qddqddq", 2, 1.5, 2.5, 3, 10, 20, -1) if i % 2 else struct.pack("<Q", 0)
        found["images"] += seen
    for i, (point, colour) in enumerate(zip(points, colours.tolist(), strict=True)):
        found["points3D"] += struct.pack("<Q3d3BdQ6i", i, *point, *colour, 0.5, 3, 1, 0, 2, 0, 3, i)
    return found
