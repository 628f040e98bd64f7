"""`gltf-splats`: 3D Gaussians in binary glTF 2.0, by the Khronos extension KHR_gaussian_splatting.

    POSITION, COLOR_0                      points that viewers without the extension show, linear colours
    KHR_gaussian_splatting:ROTATION        unit quaternion, w last        …:SCALE    standard deviations
    KHR_gaussian_splatting:OPACITY         0 … 1                          …:SH_DEGREE_l_COEF_n    r, g, b

Colours are display-encoded (srgb_rec709_display). glTF has +y up: a node turns the scene, whose +z is up.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.formats.format import Format, Shot
from mi_refgs.formats.gaussian_ply import ALONE, DEGREE
from mi_refgs.io.files import write_bytes

if TYPE_CHECKING:
    import numpy as np

    from mi_refgs.runs.trained_scene import TrainedScene

NAME = "KHR_gaussian_splatting"
FLOAT, POINTS, VERTICES = 5126, 0, 34962
"""glTF's numbers of a component type, of a mode, and of a buffer's use."""
UPRIGHT = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)
"""Quaternion (x, y, z, w) of the turn by -90° about x that takes +z to +y."""


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, degree: int, object: bool
) -> list[Path]:
    """Write the file; see `Format.write`."""
    from mi_refgs.formats.splats import gaussians

    write_bytes(target, _encoded(gaussians(trained, shots, degree, object).to_numpy()))
    return [target]


def _encoded(raw: dict[str, np.ndarray]) -> bytes:
    """The bytes of the file."""
    import numpy as np

    from mi_refgs.io.images import linear_from_srgb
    from mi_refgs.surfels.attributes import SH_DC, sigmoid

    harmonics, opacity = raw["radiance_sh"], sigmoid(raw["opacity"])
    colour = linear_from_srgb(np.clip(0.5 + SH_DC * harmonics[:, :3], 0, 1))
    rotation = raw["rotation"].astype(np.float64)
    length = np.linalg.norm(rotation, axis=1, keepdims=True)
    rotation = np.where(length > 0, rotation / np.where(length > 0, length, 1), [0, 0, 0, 1])
    columns = {
        "POSITION": raw["position"],
        "COLOR_0": np.concatenate([colour, opacity], axis=1),
        f"{NAME}:ROTATION": rotation,
        f"{NAME}:SCALE": np.exp(raw["scale"].astype(np.float64)),
        f"{NAME}:OPACITY": opacity,
    }
    for k in range(harmonics.shape[1] // 3):
        level = int(k**0.5)
        columns[f"{NAME}:SH_DEGREE_{level}_COEF_{k - level**2}"] = harmonics[:, 3 * k : 3 * k + 3]
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    parts, offset = [], 0
    for name, values in columns.items():
        data = np.ascontiguousarray(values, "<f4")
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[data.shape[1]]
        accessor: dict[str, Any] = {"bufferView": len(views), "componentType": FLOAT}
        accessor |= {"count": len(data), "type": kind}
        if name == "POSITION":
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": data.nbytes, "target": VERTICES})
        parts.append(data.tobytes())
        offset += data.nbytes
    extension = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    primitive = {
        "mode": POINTS,
        "attributes": {name: i for i, name in enumerate(columns)},
        "extensions": {NAME: extension},
    }
    content = {
        "asset": {"version": "2.0", "generator": "mi_refgs"},
        "extensionsUsed": [NAME],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": UPRIGHT}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", offset, b"BIN\0") + b"".join(parts)
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


GLTF_SPLATS = Format(
    "gltf-splats", "the same in binary glTF (KHR_gaussian_splatting)", ".glb", write, (DEGREE, ALONE)
)
