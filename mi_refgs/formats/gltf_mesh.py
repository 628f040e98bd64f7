"""`gltf-mesh`: glTF 2.0 in one file, a mesh with metallic-roughness textures, and a camera.

glTF is in metres with +y up, our world has +z up: (x, y, z) becomes (x, z, −y). It has no environment
light, and no principal point of a camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.formats.format import Format, Shot
from mi_refgs.formats.textured import OPTIONS
from mi_refgs.io.files import write_bytes

if TYPE_CHECKING:
    from mi_refgs.runs.trained_scene import TrainedScene
    from mi_refgs.splat.camera import Camera

Y_UP = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
"""glTF's world from ours."""
CENTRED = 0.5
"""Pixels by which a principal point may lie beside the middle without a word."""


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int) -> list[Path]:
    """Write the file `target`; see `Format.write`. The camera is that of the first shot."""
    import numpy as np
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    from mi_refgs.formats.bake import bake
    from mi_refgs.io.images import srgb_from_linear, to_8_bits

    made = bake(trained, shots, faces, texture)

    def picture(values: np.ndarray) -> Any:
        return Image.fromarray(to_8_bits(values))

    # By the specification, roughness is green and metallic is blue.
    surface = np.stack([np.zeros_like(made.roughness), made.roughness, made.metallic], axis=-1)
    material = PBRMaterial(
        name="surface",
        baseColorTexture=picture(srgb_from_linear(made.albedo)),
        metallicRoughnessTexture=picture(surface),
        metallicFactor=1.0,
        roughnessFactor=1.0,
    )
    turn = np.array(Y_UP)
    mesh = trimesh.Trimesh(
        made.vertices @ turn.T,
        made.faces,
        vertex_normals=made.normals @ turn.T,
        visual=TextureVisuals(uv=made.uv.astype(np.float64), material=material),
        process=False,
    )
    scene = trimesh.Scene()
    scene.add_geometry(mesh, node_name="object", geom_name="object")
    data: Any = trimesh.exchange.gltf.export_glb(
        scene, include_normals=True, tree_postprocessor=lambda tree: _add_camera(tree, shots[0].camera)
    )
    write_bytes(target, data)
    return [target]


def _add_camera(tree: dict[str, Any], camera: Camera) -> None:
    """The camera as a node; glTF's looks along its −z, ours along +z with +x to the left."""
    import numpy as np

    from mi_refgs.progress import warn

    right, down = float(camera.cx[0]) - camera.width / 2, float(camera.cy[0]) - camera.height / 2
    if max(abs(right), abs(down)) > CENTRED:
        warn(
            f"gltf-mesh: a glTF camera has its principal point in the middle; this one's lies {right:.1f} "
            f"pixels to the right and {down:.1f} below, by which its image is shifted"
        )
    width, height = camera.width / abs(float(camera.fx[0])), camera.height / abs(float(camera.fy[0]))
    lens = {"aspectRatio": width / height, "yfov": 2 * float(np.arctan(height / 2)), "znear": 1e-3}
    tree["cameras"] = [{"type": "perspective", "perspective": lens}]
    pose = np.eye(4)
    pose[:3] = np.array(Y_UP) @ camera.pose()[:3] @ np.diag([-1.0, 1.0, -1.0, 1.0])
    tree["nodes"].append({"name": "camera", "camera": 0, "matrix": pose.T.ravel().tolist()})
    tree["scenes"][0]["nodes"].append(len(tree["nodes"]) - 1)


GLTF_MESH = Format(
    "gltf-mesh",
    "glTF 2.0: a mesh with metallic-roughness textures",
    ".glb",
    write,
    OPTIONS,
    "export",
)
