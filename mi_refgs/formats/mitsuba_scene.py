"""Scenes of textured meshes that Mitsuba renders without this package."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh

from mi_refgs.formats.baking import TexturedMesh, bake
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import srgb_from_linear, write_png
from mi_refgs.render.scene_xml import add_sensor, put, write_xml
from mi_refgs.runs.trained_scene import LIGHT_MAP, MESH, SCENE, TrainedScene

MAX_DEPTH = 6  # edges of a path, as in `refgs dataset`
SAMPLES = 256  # samples per pixel by default; -D spp=16 on Mitsuba's command line chooses others
TEXTURES = {"base_color": "albedo.png", "roughness": "roughness.png", "metallic": "metallic.png"}
ROUGHNESSES = (0.0, 0.125, 0.1875, 0.25, 0.5, 0.75, 1.0)
DIFFUSE_RATIO = (0.9594, 0.9471, 0.9431, 0.9410, 0.9391, 0.9330, 0.9210)
"""Reflectance of our diffuse base under constant light, divided by that of `principled`, by roughness. Ours
receives the light that the specular layer transmits; that of `principled` receives all light, and is Disney's
[Burley 2015, "Extending the Disney BRDF to a BSDF", §4]."""


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int) -> list[Path]:
    """A folder that the `mitsuba` command of a plain Mitsuba renders, without this package.

        scene.xml                                path tracer, `principled`, `envmap`, a sensor per test view
        mesh.ply                                 positions, normals, texture coordinates
        albedo.png roughness.png metallic.png    textures: sRGB; linear; linear
        envmap.exr                               the light

    The parameters of `principled` are those of a run: its specular 0.5 reflects 0.04 at normal incidence.
    Only the base colour of dielectrics is lower by 4 to 8 %, because `principled` has another diffuse base.
    """
    made = bake(trained, tuple(shots), faces, texture)
    mesh = trimesh.Trimesh(made.vertices, made.faces, vertex_normals=made.normals, process=False)
    mesh.vertex_attributes.update({"s": made.uv[:, 0], "t": 1 - made.uv[:, 1]})  # v: from the first row
    data: Any = mesh.export(file_type="ply", vertex_normal=True)
    write_bytes(target / MESH, bytes(data))
    write_png(target / TEXTURES["base_color"], srgb_from_linear(base_colour(made)))
    for name in ("roughness", "metallic"):
        write_png(target / TEXTURES[name], getattr(made, name))
    made.light.write(target / LIGHT_MAP)
    scene = ElementTree.Element("scene", version="3.0.0")
    ElementTree.SubElement(scene, "default", name="spp", value=str(SAMPLES))
    put(ElementTree.SubElement(scene, "integrator", type="path"), max_depth=MAX_DEPTH, hide_emitters=True)
    put(ElementTree.SubElement(scene, "emitter", type="envmap"), filename=LIGHT_MAP)
    shape = ElementTree.SubElement(scene, "shape", type="ply", id="object")
    put(shape, filename=MESH)
    bsdf = ElementTree.SubElement(shape, "bsdf", type="principled")
    for name, file in TEXTURES.items():
        image = ElementTree.SubElement(bsdf, "texture", type="bitmap", name=name)
        put(image, filename=file, raw=name != "base_color")
    put(bsdf, specular=0.5)
    for index, shot in enumerate(shot for shot in shots if shot.split == shots[0].split):
        add_sensor(scene, shot.camera, f"sensor_{index}")
    write_xml(target / SCENE, scene)
    return [target / name for name in (SCENE, MESH, *TEXTURES.values(), LIGHT_MAP)]


def base_colour(made: TexturedMesh) -> np.ndarray:
    """Return the `base_color` (N, N, 3) with which `principled` reflects as much constant light as ours."""
    dielectric = np.interp(made.roughness, ROUGHNESSES, DIFFUSE_RATIO)
    return made.albedo * (made.metallic + (1 - made.metallic) * dielectric)[..., None].astype(np.float32)
