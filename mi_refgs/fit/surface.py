"""The surface of surfels, as a mesh of the depth that training views show."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import tee

from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.tsdf import bounds_from_points, fuse
from mi_refgs.render.pipeline import render_depth
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels


def surface_of(surfels: Surfels, cameras: Sequence[Camera], resolution: int) -> Mesh:
    """The mesh of the depth rendered in all cameras, fused in `resolution` voxels along the longest side."""
    views = tee(render_depth(surfels, camera) for camera in cameras)
    volume = fuse(
        (depth for depth, _ in views[0]),
        (alpha for _, alpha in views[1]),
        iter(cameras),
        bounds_from_points(surfels.to_numpy()["position"]),
        resolution,
    )
    return extract_mesh(volume)
