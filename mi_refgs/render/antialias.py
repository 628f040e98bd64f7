"""Antialiasing of reflections: each pixel, composited once, is shaded at four interpolated points."""

import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi

from mi_refgs.render.stencil import neighbours
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.splat import Camera
from mi_refgs.splat.lanes import CompactedPixels
from mi_refgs.types import Float

NODE = 0.5 / math.sqrt(3)  # pixels from the centre, per axis: Gauss-Legendre, exact for cubic radiance
NODES = [(x, y) for y in (-1, 1) for x in (-1, 1)]  # quadrant of each point
STEPS = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]  # steps to the neighbours


def averaged(
    shade: Callable[[ShadingPoints], RadianceTerms],
    points: ShadingPoints,  # (P,) at the pixels' centres, with the normals as they were blended
    alpha: Float,  # (P,) by which normals are premultiplied
    camera: Camera,
    pixels: CompactedPixels | None,  # those of the P; None: all, in raster order
    visibility: bool,
) -> RadianceTerms:
    """Mean over each pixel of the radiance at NODES, under AD. Normals, as blended, and visibility (if
    `visibility`), weighted by alpha, are interpolated; materials are the centre's: textures stay sharp."""
    ray = None if pixels is None else pixels.raster
    normal = [_interpolated(plane, camera, pixels) for plane in points.normal]
    free = None
    if visibility:
        total = _interpolated(alpha, camera, pixels)
        visible = _interpolated(alpha * points.visibility, camera, pixels)
        free = [dr.select(t > 0, v / dr.select(t > 0, t, 1), 1) for v, t in zip(visible, total, strict=True)]
    found = []
    for i, (x, y) in enumerate(NODES):
        view = -dr.normalize(camera.rays(ray, (NODE * x, NODE * y)))
        at_node = ShadingPoints(mi.Vector3f(*(plane[i] for plane in normal)), view, points.attributes)
        found.append(shade(at_node if free is None else at_node.replaced(visibility=free[i])).known())
    mean = {name: sum(terms[name] for terms in found) / len(found) for name in found[0]}
    return RadianceTerms(**mean)


def _interpolated(plane: Float, camera: Camera, pixels: CompactedPixels | None) -> list[Float]:
    """Values (P,) at each of NODES of a plane (P,) given at pixel centres."""
    at = dict(zip(STEPS, neighbours(plane, camera.width, camera.height, STEPS, pixels), strict=True))
    side, corner = NODE * (1 - NODE), NODE**2
    centre = (1 - NODE) ** 2 * plane
    return [centre + side * (at[x, 0] + at[0, y]) + corner * at[x, y] for x, y in NODES]
