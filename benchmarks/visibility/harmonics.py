"""The best that the indirect channel can be: spherical harmonics fitted to what the path tracer sees.

At every point, the product's degree: the least squares over all directions of the upper hemisphere in which
something stands in the way. Free directions have no say, as in a fit to photographs, where the factor
1 - visibility silences them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.view import Points
from mi_refgs.shade.sh import clamp_positive, eval_sh, sh_basis
from mi_refgs.surfels.attributes import MAX_SH_DEGREE

DEGREE = MAX_SH_DEGREE
"""Of the product's indirect channel, unless told otherwise."""
RIDGE = 1e-3
"""Penalty on the coefficients, in multiples of what all directions of a hemisphere weigh: it decides where
hardly any direction is blocked. From 1e-4 to 1e-2 the relMSE of the picture changes by less than a tenth in
the bowls and for rough plates; for plates of roughness 0.1 it goes from 0.04 to 0.08, and is 0.06 here."""


@dataclass(frozen=True)
class Sums:
    """Of the least squares at P points, K coefficients: A'A (P, K, K) and A'b (P, K, 3) per direction."""

    normal: np.ndarray
    right: np.ndarray

    def solve(self) -> np.ndarray:
        """Coefficients (P, K, 3)."""
        # The basis is orthonormal: its mean square over directions is 1/4π.
        ridge = RIDGE / (4 * np.pi) * np.eye(self.normal.shape[-1])
        return np.linalg.solve(self.normal + ridge, self.right)


def mean(parts: list[Sums]) -> Sums:
    """Of as many directions each."""
    return Sums(np.mean([part.normal for part in parts], 0), np.mean([part.right for part in parts], 0))


def sums(basis: np.ndarray, radiance: np.ndarray, blocked: np.ndarray) -> Sums:
    """Of D directions: basis (P, D, K), radiance (P, D, 3), blocked (P, D)."""
    rows = np.swapaxes(basis * blocked[..., None], 1, 2)
    return Sums(
        (rows @ basis).astype(np.float64) / basis.shape[1],
        (rows @ radiance).astype(np.float64) / basis.shape[1],
    )


def traced(scene: Any, points: Points, depth: int, directions: int, seed: int) -> Sums:
    """One path of Mitsuba's `path` into each direction of a lattice that every point shifts at random.

    `depth` is the `max_depth` of the picture that this light is a part of: one reflection, at the point, is
    behind the path already. `directions` is one of `montecarlo.LATTICES`.
    """
    path = mi.load_dict({"type": "path", "max_depth": depth - 1, "rr_depth": 1000, "hide_emitters": True})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, points.count * directions)
    lane = dr.arange(mi.UInt32, points.count * directions)
    point, index = lane // directions, lane % directions
    rng = mi.PCG32(size=points.count, initstate=mi.UInt64(seed))
    shift = dr.gather(mi.Point2f, mi.Point2f(rng.next_float32(), rng.next_float32()), point)
    at = shift + mc.lattice(index, mi.UInt32(directions), mi.UInt32(mc.predecessor(directions)))
    every = points.gather(point)
    direction = mi.Frame3f(every.normal).to_world(mi.warp.square_to_uniform_hemisphere(at - dr.floor(at)))
    ray = mi.RayDifferential3f(every.position + mc.RAY_OFFSET * every.offset, direction)
    # Without emitters in sight, valid is what hits a surface: the light itself is not indirect light.
    radiance, blocked, _ = path.sample(scene, sampler, ray)
    basis = sh_basis(direction, DEGREE)
    dr.eval(radiance, blocked, basis)

    def rows(values: Any) -> np.ndarray:
        columns = [np.array(value, np.float32).reshape(points.count, directions) for value in values]
        return np.stack(columns, axis=-1)

    return sums(rows(basis), rows(radiance), np.array(blocked).reshape(points.count, directions))


def along(coefficients: np.ndarray, direction: Any) -> Any:
    """Radiance (mi.Color3f) of coefficients (P, K, 3) along one direction at each point, never negative."""
    columns = [mi.Color3f(np.ascontiguousarray(c.T, np.float32)) for c in np.swapaxes(coefficients, 0, 1)]
    return clamp_positive(eval_sh(columns, direction))


class Surroundings:
    """Harmonics at each of P points as an emitter for `montecarlo.integrate`, which is never sampled itself.

    Lane i is point i modulo P, as there.
    """

    def __init__(self, coefficients: np.ndarray) -> None:
        self.count, terms = coefficients.shape[:2]
        self.degree = int(np.sqrt(terms)) - 1
        flat = np.ascontiguousarray(np.swapaxes(coefficients, 1, 2), np.float32).ravel()
        self.flat = mi.Float(flat)
        dr.eval(self.flat)

    def eval(self, si: Any) -> Any:
        """Radiance from -wi."""
        basis = sh_basis(-si.wi, self.degree)
        lane = dr.arange(mi.UInt32, dr.width(si.wi)) % self.count
        channels = []
        for channel in range(3):
            first = (3 * lane + channel) * len(basis)
            terms = [dr.gather(mi.Float, self.flat, first + k) * y for k, y in enumerate(basis)]
            channels.append(sum(terms))
        return clamp_positive(mi.Color3f(*channels))

    def pdf_direction(self, si: Any, ds: Any) -> Any:
        """0 everywhere."""
        return mi.Float(0)

    def sample_direction(self, si: Any, u: Any) -> tuple[Any, Any]:
        """Nothing."""
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = mi.Vector3f(0, 0, 1)
        return ds, mi.Color3f(0)
