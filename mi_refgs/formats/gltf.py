"""Binary glTF 2.0 files of meshes and of Gaussians."""

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from mi_refgs.formats.baking import bake
from mi_refgs.formats.format import Shot
from mi_refgs.formats.gaussians import gaussians
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import linear_from_srgb, srgb_from_linear, to_8_bits
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import SH_DC, sigmoid
from mi_refgs.surfels.table import Surfels

Y_UP = np.array(((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)))  # glTF's world from ours
Y_UP_QUATERNION = (-(0.5**0.5), 0.0, 0.0, 0.5**0.5)  # the same (x, y, z, w): the turn by -90° about x
EXTENSION = "KHR_gaussian_splatting"
FLOAT, POINTS, VERTICES = 5126, 0, 34962  # of a component type, of a mode, of a buffer's use


def write_mesh(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int
) -> list[Path]:
    """glTF 2.0 in one file, metres, +y up: (x, y, z) becomes (x, z, −y); without an environment light."""
    made = bake(trained, tuple(shots), faces, texture)
    # By the specification, roughness is green and metallic is blue.
    surface = np.stack([np.zeros_like(made.roughness), made.roughness, made.metallic], axis=-1)
    material = PBRMaterial(
        name="surface",
        baseColorTexture=Image.fromarray(to_8_bits(srgb_from_linear(made.albedo))),
        metallicRoughnessTexture=Image.fromarray(to_8_bits(surface)),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )
    vertices, normals = made.vertices @ Y_UP.T, made.normals @ Y_UP.T
    visual = TextureVisuals(uv=made.uv.astype(np.float64), material=material)
    mesh = trimesh.Trimesh(vertices, made.faces, vertex_normals=normals, visual=visual, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="object", geom_name="object")
    write_bytes(target, trimesh.exchange.gltf.export_glb(scene, include_normals=True))
    return [target]


def write_gaussians(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, degree: int, object: bool
) -> list[Path]:
    """3D Gaussians in binary glTF 2.0, by the Khronos extension KHR_gaussian_splatting.

        POSITION, COLOR_0                      points that viewers without the extension show, linear colours
        KHR_gaussian_splatting:ROTATION        unit quaternion, w last        …:SCALE    standard deviations
        KHR_gaussian_splatting:OPACITY         0 … 1                          …:SH_DEGREE_l_COEF_n    r, g, b

    Colours are display-encoded (srgb_rec709_display). glTF has +y up: a node turns the scene, whose +z is up.
    """
    columns = _attributes(gaussians(trained, shots, degree, object))
    # Accessors and views of one buffer, in the order of the attributes.
    accessors: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    buffer = bytearray()
    for name, values in columns.items():
        data = np.ascontiguousarray(values, "<f4")
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[data.shape[1]]
        accessor = {"bufferView": len(views), "componentType": FLOAT, "count": len(data), "type": kind}
        if name == "POSITION":
            accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        accessors.append(accessor)
        views.append({"buffer": 0, "byteOffset": len(buffer), "byteLength": data.nbytes, "target": VERTICES})
        buffer += data.tobytes()
    extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    extension |= {"projection": "perspective", "sortingMethod": "cameraDistance"}
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"mode": POINTS, "attributes": attributes, "extensions": {EXTENSION: extension}}
    content = {
        "asset": {"version": "2.0", "generator": "mi_refgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": Y_UP_QUATERNION}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    # Chunks: JSON padded by blanks, then the buffer.
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + bytes(buffer)
    write_bytes(target, struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return [target]


def _attributes(table: Surfels) -> dict[str, np.ndarray]:
    """Return the vertex attributes (N, …) of Gaussians by name."""
    raw, rotation = table.to_numpy(), table.rotation()
    sh, opacity = raw["radiance_sh"], sigmoid(raw["opacity"])
    colour = linear_from_srgb(np.clip(0.5 + SH_DC * sh[:, :3], 0, 1))
    columns = {
        "POSITION": raw["position"],
        "COLOR_0": np.concatenate([colour, opacity], axis=1),
        f"{EXTENSION}:ROTATION": np.stack([rotation.x, rotation.y, rotation.z, rotation.w], axis=1),
        f"{EXTENSION}:SCALE": np.exp(raw["scale"].astype(np.float64)),
        f"{EXTENSION}:OPACITY": opacity,
    }
    for k in range(sh.shape[1] // 3):
        level = int(k**0.5)
        columns[f"{EXTENSION}:SH_DEGREE_{level}_COEF_{k - level**2}"] = sh[:, 3 * k : 3 * k + 3]
    return columns
