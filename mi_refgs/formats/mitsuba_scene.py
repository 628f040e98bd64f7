"""`mitsuba`: a folder that the `mitsuba` command of a plain Mitsuba renders, without this package.

    scene.xml                                    path tracer, `principled`, `envmap`, a sensor a test view
    mesh.ply                                     positions, normals, texture coordinates
    albedo.png roughness.png metallic.png        textures: sRGB; linear; linear
    envmap.exr                                   the light

The parameters of `principled` are those of a run: its specular 0.5 reflects 0.04 at normal incidence. Only
the base colour of dielectrics is another, by some percent (`formats.principled`).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from mi_refgs.formats.format import Format, Shot
from mi_refgs.formats.textured import OPTIONS
from mi_refgs.io.files import make_folder, write_bytes

if TYPE_CHECKING:
    from mi_refgs.formats.textured import TexturedMesh
    from mi_refgs.runs.trained_scene import TrainedScene

MAX_DEPTH = 6
"""Edges of a path, as in `refgs dataset`."""
SAMPLES = 256
"""Samples per pixel by default; -D spp=16 on Mitsuba's command line asks for others."""
SCENE, MESH, LIGHT = "scene.xml", "mesh.ply", "envmap.exr"
TEXTURES = {"base_color": "albedo.png", "roughness": "roughness.png", "metallic": "metallic.png"}


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot], faces: int, texture: int) -> list[Path]:
    """Write the folder `target`; see `Format.write`. The sensors are those of the test views."""
    from mi_refgs.formats.bake import bake
    from mi_refgs.formats.principled import base_colour
    from mi_refgs.io.images import srgb_from_linear, write_png
    from mi_refgs.render.scene_xml import add_sensor, put, write_xml

    made = bake(trained, shots, faces, texture)
    make_folder(target)
    write_bytes(target / MESH, _ply(made))
    write_png(target / TEXTURES["base_color"], srgb_from_linear(base_colour(made)))
    for name in ("roughness", "metallic"):
        write_png(target / TEXTURES[name], getattr(made, name))
    made.light.write(target / LIGHT)

    scene = ElementTree.Element("scene", version="3.0.0")
    put(scene, "default", "spp", str(SAMPLES))
    integrator = ElementTree.SubElement(scene, "integrator", type="path")
    put(integrator, "integer", "max_depth", str(MAX_DEPTH))
    put(integrator, "boolean", "hide_emitters", "true")
    put(ElementTree.SubElement(scene, "emitter", type="envmap"), "string", "filename", LIGHT)
    shape = ElementTree.SubElement(scene, "shape", type="ply", id="object")
    put(shape, "string", "filename", MESH)
    bsdf = ElementTree.SubElement(shape, "bsdf", type="principled")
    for name, file in TEXTURES.items():
        image = ElementTree.SubElement(bsdf, "texture", type="bitmap", name=name)
        put(image, "string", "filename", file)
        put(image, "boolean", "raw", str(name != "base_color").lower())
    put(bsdf, "float", "specular", "0.5")
    for index, shot in enumerate(shot for shot in shots if shot.split == shots[0].split):
        add_sensor(scene, shot.camera, f"sensor_{index}")
    write_xml(target / SCENE, scene)
    return [target / name for name in (SCENE, MESH, *TEXTURES.values(), LIGHT)]


def _ply(made: TexturedMesh) -> bytes:
    """The mesh; Mitsuba's v begins at the first row of a texture."""
    import trimesh

    mesh = trimesh.Trimesh(made.vertices, made.faces, vertex_normals=made.normals, process=False)
    mesh.vertex_attributes.update({"s": made.uv[:, 0], "t": 1 - made.uv[:, 1]})
    data: Any = mesh.export(file_type="ply", vertex_normal=True)
    return bytes(data)


MITSUBA = Format(
    "mitsuba",
    "a folder that Mitsuba renders without this package: mesh, principled, textures, envmap",
    "",
    write,
    OPTIONS,
    "export",
)
