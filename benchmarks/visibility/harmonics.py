"""The best spherical harmonics for the indirect light of each point: least squares of path-traced radiance.

They are an upper bound of what an indirect channel of the product's degree can represent along the mirror
direction, as the paper's rule looks it up."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.view import Points, rows
from benchmarks.visibility.setup import Setup
from mi_refgs.shade.points import reflect
from mi_refgs.shade.sh import clamp_positive, eval_sh, sh_basis
from mi_refgs.surfels.attributes import MAX_SH_DEGREE

DEGREE = MAX_SH_DEGREE  # SH degree of the product's indirect channel
RIDGE = 1e-3
"""Penalty on the coefficients, in multiples of the weight of a whole hemisphere: it decides where hardly any
direction is blocked. From 1e-4 to 1e-2, relMSE changes by less than a tenth but for plates, roughness 0.1."""
Sums = tuple[np.ndarray, np.ndarray]
"""Sums of the least squares at P points, K coefficients: A'A (P, K, K), A'b (P, K, 3) per direction."""


def mirror_radiance(setup: Setup, depth: int) -> np.ndarray:
    """Return the fitted indirect radiance (P, 3) along the mirror direction, of the path tracer's `depth`."""
    settings, points = setup.settings, setup.points
    seeds = range(1, settings.batches + 1)
    coefficients = solve([traced(setup.scene, points, depth, settings.lattice, seed) for seed in seeds])
    return rows(along(coefficients, reflect(points.view, points.normal)))


def solve(parts: list[Sums]) -> np.ndarray:
    """Return coefficients (P, K, 3) from batches of equally many directions."""
    normal, right = (np.mean(found, axis=0) for found in zip(*parts, strict=True))
    # The basis is orthonormal: its mean square over directions is 1/4π.
    return np.linalg.solve(normal + RIDGE / (4 * np.pi) * np.eye(normal.shape[-1]), right)


def sums(basis: np.ndarray, radiance: np.ndarray, blocked: np.ndarray) -> Sums:
    """Return the sums of D directions: basis (P, D, K), radiance (P, D, 3), blocked (P, D)."""
    columns = np.swapaxes(basis * blocked[..., None], 1, 2)
    normal, right = ((columns @ values).astype(np.float64) / basis.shape[1] for values in (basis, radiance))
    return normal, right


def traced(scene: Any, points: Points, depth: int, directions: int, seed: int) -> Sums:
    """Trace one path of Mitsuba's `path` into each direction of a lattice that every point shifts at random.

    `depth` is the `max_depth` of the image that this light is a part of: one reflection, at the point, is
    behind the path already. `directions` is one of `montecarlo.LATTICES`."""
    path = mi.load_dict({"type": "path", "max_depth": depth - 1, "rr_depth": 1000, "hide_emitters": True})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, points.count * directions)
    lane = dr.arange(mi.UInt32, points.count * directions)
    point, index = lane // directions, lane % directions
    rng = mi.PCG32(size=points.count, initstate=mi.UInt64(seed))
    shift = dr.gather(mi.Point2f, mi.Point2f(rng.next_float32(), rng.next_float32()), point)
    at = mc.lattice(index, mi.UInt32(directions), mi.UInt32(mc.predecessor(directions)), shift)
    every = points.gather(point)
    direction = mi.Frame3f(every.normal).to_world(mi.warp.square_to_uniform_hemisphere(at))
    ray = mi.RayDifferential3f(every.position + mc.RAY_OFFSET * every.offset, direction)
    # Without visible emitters, valid is what hits a surface: the light itself is not indirect light.
    radiance, blocked, _ = path.sample(scene, sampler, ray)
    basis = sh_basis(direction, DEGREE)
    dr.eval(radiance, blocked, basis)

    def columns(values: Any) -> np.ndarray:
        found = [np.array(value, np.float32).reshape(points.count, directions) for value in values]
        return np.stack(found, axis=-1)

    return sums(columns(basis), columns(radiance), np.array(blocked).reshape(points.count, directions))


def along(coefficients: np.ndarray, direction: Any) -> Any:
    """Return radiance (mi.Color3f) of coefficients (P, K, 3) along one direction per point, at least 0."""
    columns = [mi.Color3f(np.ascontiguousarray(c.T, np.float32)) for c in np.swapaxes(coefficients, 0, 1)]
    return clamp_positive(eval_sh(columns, direction))
