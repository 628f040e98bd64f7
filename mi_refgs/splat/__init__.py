"""The splatter: project surfels, list them by tile, composite features front to back."""

from __future__ import annotations

from mi_refgs.kernels.timing import phase
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.composite import Composited, composite, composite_compact
from mi_refgs.splat.tiles import TileLists, list_by_tile
from mi_refgs.surfels.primitives import Footprints
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

__all__ = [
    "Camera",
    "Composited",
    "Footprints",
    "TileLists",
    "composite",
    "list_by_tile",
    "project",
    "splat",
    "splat_compact",
]


@phase("project")
def project(surfels: Surfels, camera: Camera) -> Footprints:
    """Footprints of surfels in a camera."""
    return surfels.primitive.project(surfels, camera)


def splat(
    surfels: Surfels,
    features: list[Float],  # K × (N,)
    camera: Camera,
) -> Composited:
    """Splat features of surfels to maps of H·W pixels in raster order; derivatives as in `composite`."""
    if surfels.count == 0:
        return Composited.nothing(len(features), camera)
    footprints = project(surfels, camera)
    lists = list_by_tile(footprints, camera, features)
    return composite(footprints, features, lists)


def splat_compact(
    surfels: Surfels, features: list[Float], camera: Camera, *, depth: bool, draft: bool = False
) -> Composited:
    """Splat features of surfels as `composite_compact` does: only pixels near surfels, no derivatives."""
    if surfels.count == 0:
        return Composited.nothing(len(features), camera, depth)
    return composite_compact(list_by_tile(project(surfels, camera), camera, features), depth, draft)
