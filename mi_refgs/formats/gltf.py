"""Binary glTF 2.0 files of meshes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

from mi_refgs.formats.baking import bake
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import srgb_from_linear, to_8_bits
from mi_refgs.runs.trained_scene import TrainedScene

Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))  # glTF's world from ours


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int) -> list[Path]:
    """glTF 2.0 in one file, metres, +y up: (x, y, z) becomes (x, z, −y); without an environment light."""
    made = bake(trained, shots, faces, texture)
    # By the specification, roughness is green and metallic is blue.
    surface = np.stack([np.zeros_like(made.roughness), made.roughness, made.metallic], axis=-1)
    material = PBRMaterial(
        name="surface",
        baseColorTexture=Image.fromarray(to_8_bits(srgb_from_linear(made.albedo))),
        metallicRoughnessTexture=Image.fromarray(to_8_bits(surface)),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )
    turn = np.array(Y_UP)
    vertices, normals = made.vertices @ turn.T, made.normals @ turn.T
    visual = TextureVisuals(uv=made.uv.astype(np.float64), material=material)
    mesh = trimesh.Trimesh(vertices, made.faces, vertex_normals=normals, visual=visual, process=False)
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="object", geom_name="object")
    write_bytes(target, trimesh.exchange.gltf.export_glb(scene, include_normals=True))
    return [target]
