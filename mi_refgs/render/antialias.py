"""Antialiasing of reflections: each pixel is shaded at four points, at interpolated normals and visibility.

Compositing is most of the time of an image, and a blended normal varies slowly where the surface is smooth;
its reflection does not. So surfels are composited once per pixel, and their reflection is averaged over it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mi_refgs.render.stencil import neighbours
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.splat import Camera
from mi_refgs.splat.lanes import CompactedPixels
from mi_refgs.types import Float

NODE = 0.5 / math.sqrt(3)
"""Distance of the points from the pixel's centre along each axis, pixels: the nodes of the Gauss-Legendre
rule, whose mean over two nodes per axis is exact for radiance that is cubic in the position."""

NODES = [(x, y) for y in (-1, 1) for x in (-1, 1)]
"""Quadrant of each point: signs of its offset from the centre."""

AROUND = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]
"""Steps to the neighbours whose values are interpolated."""


def averaged(
    shade: Callable[[ShadingPoints], RadianceTerms],
    points: ShadingPoints,  # (P,) at the pixels' centres, with the normals as they were blended
    alpha: Float,  # (P,) by which normals are premultiplied
    camera: Camera,
    pixels: CompactedPixels | None,  # those of the P; None: all, in raster order
    visibility: bool,
) -> RadianceTerms:
    """Mean over each pixel of the radiance at NODES, under AD.

    Normals are interpolated bilinearly between pixel centres as they were blended, so that empty pixels do
    not count, and visibility if `visibility`, weighted by alpha. Materials and radiance are those of the
    centre: fits represent textures at pixel centres, and interpolation would blur them.
    """
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
    return RadianceTerms(**{name: _mean([terms[name] for terms in found]) for name in found[0]})


def _interpolated(plane: Float, camera: Camera, pixels: CompactedPixels | None) -> list[Float]:
    """Values (P,) at each of NODES of a plane (P,) given at pixel centres."""
    beside = neighbours(plane, camera.width, camera.height, AROUND, pixels)
    at = dict(zip(AROUND, beside, strict=True))
    side, corner = NODE * (1 - NODE), NODE**2
    centre = (1 - NODE) ** 2 * plane
    return [centre + side * (at[x, 0] + at[0, y]) + corner * at[x, y] for x, y in NODES]


def _mean(values: Sequence[mi.Color3f]) -> mi.Color3f:
    return sum(values[1:], values[0]) / len(values)
