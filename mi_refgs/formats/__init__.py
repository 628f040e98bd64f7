"""Files of other programs: the formats that `refgs export --to` and `Reconstruction.export` write.

The command line reads these declarations before it runs anything, so they do not import what computes.
"""

from functools import partial

from mi_refgs.formats.format import FORMATS, Format, Option, Shot, Writer, options_of, write

_OBJECT = Option(
    "object", False, "the object without its background Gaussians; splat files have no environment"
)
_DEGREE = Option("degree", 3, "SH degree of the colours of exported Gaussians, 0 to 3")
_FACES = Option("faces", 50_000, "maximum number of triangles of an exported mesh")
_TEXTURE = Option("texture", 1024, "texels along each side of its textures")
_VIEW = Option("view", 0, "the view of an EXR file, by number; test views come first")
_SAMPLES = Option("samples", 4, "samples per pixel of an EXR file, box filtered: 4 are 2 × 2")

_splats = partial(Format, options=(_DEGREE, _OBJECT))
_mesh = partial(Format, options=(_FACES, _TEXTURE), extra="export")
for _format in (
    _splats("3dgs-ply", "3D Gaussians with baked colours, for splat viewers", ".ply", Writer("gaussian_ply")),
    _splats(
        "gltf-splats",
        "the same in binary glTF (KHR_gaussian_splatting)",
        ".glb",
        Writer("gltf", "write_gaussians"),
    ),
    _mesh(
        "gltf-mesh", "glTF 2.0: a mesh with metallic-roughness textures", ".glb", Writer("gltf", "write_mesh")
    ),
    _mesh(
        "mitsuba",
        "a folder that Mitsuba renders without this package: mesh, principled, textures, envmap",
        "",
        Writer("mitsuba_scene"),
    ),
    Format("cameras", "transforms.json and COLMAP's text files of the cameras", "", Writer("cameras")),
    Format("exr", "one view with all its layers", ".exr", Writer("exr_layers"), (_VIEW, _SAMPLES, _OBJECT)),
):
    FORMATS.register(_format)

__all__ = ["FORMATS", "Format", "Option", "Shot", "Writer", "options_of", "write"]
