"""Real spherical harmonics up to degree 3 in the sign convention of the 3DGS family.

Y_00 = ½√(1/π) and, in degree 1, (-y, +z, -x)·½√(3/π): the Condon-Shortley phase (-1)^m is kept, so that files
of other programs hold the same coefficients. [Ramamoorthi and Hanrahan 2001; Sloan 2013]"""

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.surfels.attributes import MAX_SH_DEGREE
from mi_refgs.types import Color3f, Float, Vector3f


def sh_basis(direction: Vector3f, degree: int) -> list[Float]:
    """The (degree + 1)² basis functions at unit directions, ordered by degree l ≤ 3, then m = -l … l."""
    x, y, z = direction.x, direction.y, direction.z
    basis: list[Any] = [dr.full(mi.Float, 0.5 * math.sqrt(1 / math.pi), dr.width(x))]
    if degree >= 1:
        k = 0.5 * math.sqrt(3 / math.pi)
        basis += [-k * y, k * z, -k * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        k = 0.5 * math.sqrt(15 / math.pi)
        basis += [
            k * x * y,
            -k * y * z,
            0.25 * math.sqrt(5 / math.pi) * (2 * zz - xx - yy),
            -k * x * z,
            0.5 * k * (xx - yy),
        ]
    if degree >= 3:
        k33, k31 = (0.25 * math.sqrt(n / (2 * math.pi)) for n in (35, 21))
        k32 = 0.5 * math.sqrt(105 / math.pi)
        basis += [
            -k33 * y * (3 * xx - yy),
            k32 * x * y * z,
            -k31 * y * (4 * zz - xx - yy),
            0.25 * math.sqrt(7 / math.pi) * z * (2 * zz - 3 * xx - 3 * yy),
            -k31 * x * (4 * zz - xx - yy),
            0.5 * k32 * z * (xx - yy),
            -k33 * x * (xx - 3 * yy),
        ]
    return basis


def eval_sh(coefs: Sequence[Color3f], direction: Vector3f) -> Color3f:
    """Σ coefs[i] basis_i(direction), not clamped, of 1, 4, 9 or 16 colours (else InputError)."""
    degree = math.isqrt(len(coefs)) - 1
    if (degree + 1) ** 2 != len(coefs) or not 0 <= degree <= MAX_SH_DEGREE:
        raise InputError(f"{len(coefs)} colours", "eval_sh", "coefs", "give 1, 4, 9 or 16, for degree 0 … 3")
    colour = mi.Color3f(0)
    for coef, basis in zip(coefs, sh_basis(direction, degree), strict=True):
        colour = dr.fma(coef, basis, colour)
    return colour


def clamp_positive(x: Any) -> Any:
    """max(0, x) with derivative 1 at exactly 0: coefficients that start at 0 must be able to leave it."""
    return dr.maximum(0, x)
