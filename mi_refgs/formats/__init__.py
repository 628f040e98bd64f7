"""Formats of other programs, one file each; importing this package registers those that ship.

A new one is a file that declares a `Format`, and its line here.
"""

from mi_refgs.formats import cameras, gaussian_ply, gltf_mesh, gltf_splats, layers, mitsuba_scene, usd
from mi_refgs.formats.format import FORMATS, Format, Option, Shot, options_of, register, write

register(gaussian_ply.GAUSSIAN_PLY)
register(gltf_splats.GLTF_SPLATS)
register(gltf_mesh.GLTF_MESH)
register(mitsuba_scene.MITSUBA)
register(usd.USD)
register(cameras.CAMERAS)
register(layers.EXR)

__all__ = ["FORMATS", "Format", "Option", "Shot", "options_of", "register", "write"]
