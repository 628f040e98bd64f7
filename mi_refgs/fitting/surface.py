"""Mesh of the surfels' surface, fused from rendered depth, and the occluder's caches."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import tee

import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.occlusion.mesh import Mesh, extract_mesh
from mi_refgs.occlusion.tsdf import bounds_from_points, fuse
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import render_depth
from mi_refgs.shade.ambient import update_occluder_caches
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels


def surface_of(
    surfels: Surfels,
    cameras: Sequence[Camera],
    resolution: int,
    around: Surfels | None = None,
    region: Region | None = None,
) -> Mesh:
    """Fuse the depth rendered in all cameras, with `resolution` voxels along the longest side, into a mesh.

    With a `region` and background surfels `around`, in all of space by the region's contraction, with
    `resolution` voxels along its diameter.
    """
    points = surfels.to_numpy()["position"]
    if around is None or region is None:
        around, region, bounds = None, None, bounds_from_points(points)
    else:
        points = np.concatenate([points, around.to_numpy()["position"]])
        low, high = bounds_from_points(region.contract(points[np.isfinite(points).all(axis=1)]))
        bounds = np.maximum(low, -2), np.minimum(high, 2)
    views = tee(render_depth(surfels, camera, around) for camera in cameras)
    volume = fuse(
        (depth for depth, _ in views[0]),
        (alpha for _, alpha in views[1]),
        iter(cameras),
        bounds,
        resolution,
        carve=region is None,
        region=region,
    )
    return extract_mesh(volume)


def update_missing_caches(
    occluder: Occluder, surfels: Surfels, environment: EnvironmentLight | None, shading: Shading
) -> None:
    """Compute the caches that the shading requires and the occluder lacks: all for a new mesh, the surfels at
    its vertices also after surfels were added or removed.
    """
    if shading.ambient_rays and occluder.ambient is None:
        update_occluder_caches(occluder, surfels, shading.light_of(environment), shading)
    if shading.traced_bounces and occluder.vertex_surfels is None:
        occluder.set_materials(surfels)
