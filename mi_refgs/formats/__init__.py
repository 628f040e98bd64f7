"""Formats that `refgs export --to` and `Reconstruction.export` write. Their code is imported when it runs."""

from mi_refgs.formats.format import FORMATS, Format, Option, Shot as Shot, write as write

_OBJECT = Option("object", False, "without background Gaussians; splat files have no environment")
_DEGREE = Option("degree", 3, "SH degree of the colours of exported Gaussians, 0 to 3")
_FACES = Option("faces", 50_000, "maximum number of triangles of an exported mesh")
_TEXTURE = Option("texture", 1024, "texels along each side of its textures")
_VIEW = Option("view", 0, "the view of an EXR file, by number; test views come first")
_SAMPLES = Option("samples", 4, "samples per pixel of an EXR file, box filtered: 4 are 2 × 2")

_SPLATS, _MESH = (_DEGREE, _OBJECT), ((_FACES, _TEXTURE), "export")
for _name, _summary, _suffix, _write, *_more in (
    ("3dgs-ply", "3D Gaussians with baked colours, for viewers", ".ply", "gaussians:write_ply", _SPLATS),
    ("gltf-splats", "the same in glTF (KHR_gaussian_splatting)", ".glb", "gltf:write_gaussians", _SPLATS),
    ("gltf-mesh", "glTF: a mesh with metallic-roughness textures", ".glb", "gltf:write_mesh", *_MESH),
    ("mitsuba", "a folder for plain Mitsuba: a textured mesh, envmap", "", "mitsuba_scene:write", *_MESH),
    ("cameras", "transforms.json and COLMAP's text files of the cameras", "", "cameras:write"),
    ("exr", "one view with all its layers", ".exr", "exr_layers:write", (_VIEW, _SAMPLES, _OBJECT)),
):
    FORMATS.register(Format(_name, _summary, _suffix, _write, *_more))
