"""What the formats of textured meshes share: their options, and what is baked for them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from mi_refgs.errors import InputError
from mi_refgs.formats.format import Option

if TYPE_CHECKING:
    import numpy as np

    from mi_refgs.shade.light.envmap import EnvironmentLight

OPTIONS = (
    Option("faces", 50_000, "triangles of an exported mesh, at most"),
    Option("texture", 1024, "texels along each side of its textures"),
)
FACES_MIN, TEXTURE_RANGE = 100, (16, 8192)


@dataclass(frozen=True, eq=False)
class TexturedMesh:
    """A mesh in world space, its materials, and the light. V vertices, F faces, N texels a side."""

    vertices: np.ndarray  # (V, 3) float32
    normals: np.ndarray  # (V, 3) float32, unit, outward
    uv: np.ndarray  # (V, 2) float32 in 0 … 1, v upwards: the first row of a texture is at v = 1
    faces: np.ndarray  # (F, 3) uint32, counter-clockwise from outside
    albedo: np.ndarray  # (N, N, 3) float32, linear
    metallic: np.ndarray  # (N, N) float32
    roughness: np.ndarray  # (N, N) float32, perceptual: GGX's α is its square
    light: EnvironmentLight


def check(faces: int, texture: int) -> None:
    """Raise InputError for a number out of range."""
    if faces < FACES_MIN:
        raise InputError(f"--faces: {faces} is out of range; give a number from {FACES_MIN}")
    low, high = TEXTURE_RANGE
    if not low <= texture <= high:
        raise InputError(f"--texture: {texture} is out of range; give {low} to {high}")
