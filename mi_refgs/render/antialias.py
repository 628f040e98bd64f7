"""Geometric antialiasing of reflections: roughness widened by the variance of normals within a pixel."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.render.stencil import neighbours
from mi_refgs.shade.points import safe_normalize
from mi_refgs.splat.camera import Camera
from mi_refgs.types import Bool, Float, Vector3f

MAX_VARIANCE = 0.18
"""Largest addition to α²; a surface that a pixel resolves adds less. [κ of Tokuyoshi and Kaplanyan]"""

NO_NEIGHBOUR = 5.0  # more than the largest squared difference of two unit vectors, 4


def widened(
    roughness: Float,  # (H·W,) at the pixel's centre
    normal: Vector3f,  # (H·W,) blended, of any length
    alpha: Float,  # (H·W,)
    camera: Camera,
) -> Float:
    """Roughness of the area of a pixel; under AD.

    With α = roughness², α² grows by the variance of the unit normals in the pixel, (|∂n/∂x|² + |∂n/∂y|²) / 12
    with derivatives per pixel, by MAX_VARIANCE at most, and to 1 at most. The smaller difference to the two
    neighbours of an axis counts, so that an edge is no curvature; pixels that see nothing (COVERAGE_FLOOR)
    are no neighbours. The variance has no derivative: a fit would bend normals to blur its reflections.

    The slopes of facets have the variance α²/2 along each axis, and those of their mean plane add up.
    [Kaplanyan et al. 2016, "Filtering Distributions of Normals for Shading Antialiasing"; isotropic and with
    a bound: Tokuyoshi and Kaplanyan 2019, "Improved Geometric Specular Antialiasing", eq. 4, whose pixel is
    a Gaussian and whose sum of both axes stands for either]
    """
    with dr.suspend_grad():
        # 1/12 squared pixels: the box filter's variance of positions along one axis.
        variance = 1 / 12 * _squared_turn(safe_normalize(normal), alpha > COVERAGE_FLOOR, camera)
        variance = dr.minimum(variance, MAX_VARIANCE)
    turned = variance > 0
    α2 = dr.minimum(dr.square(dr.square(roughness)) + variance, 1)
    # √√ has no slope at 0, where a mirror on flat ground stays what it is.
    return dr.select(turned, dr.sqrt(dr.sqrt(dr.select(turned, α2, 1))), roughness)


def _squared_turn(unit: Vector3f, seen: Bool, camera: Camera) -> Float:
    """|∂n/∂x|² + |∂n/∂y|² of unit normals, per squared pixel; 0 where nothing is seen."""
    pixel, covered = camera.pixel_centres(), dr.select(seen, mi.Float(1), mi.Float(0))
    total = mi.Float(0)
    for position, size, steps in (
        (pixel.x, camera.width, ((-1, 0), (1, 0))),
        (pixel.y, camera.height, ((0, -1), (0, 1))),
    ):
        planes = [neighbours(part, camera.width, camera.height, steps) for part in unit]
        visible = neighbours(covered, camera.width, camera.height, steps)
        least = mi.Float(NO_NEIGHBOUR)
        for side, inside in enumerate((position > 1, position < size - 1)):
            turn = dr.squared_norm(unit - mi.Vector3f(*(plane[side] for plane in planes)))
            least = dr.select(inside & (visible[side] > 0), dr.minimum(least, turn), least)
        total += dr.select(least < NO_NEIGHBOUR, least, 0)
    return dr.select(seen, total, 0)
