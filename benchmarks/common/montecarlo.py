"""The integrals that a split sum stands for, by Monte Carlo in Dr.Jit, with Mitsuba's GGX distribution.

Nothing of `mi_refgs.shade` is used. A `Lobe` names a way to draw directions and the weights whose integrals
against the light are wanted. `integrate` combines each lobe with samples of the light (balance heuristic)
over randomly shifted Fibonacci lattices; the shifts are independent, so batches give their own standard
error. [Veach 1997, §9; Cranley and Patterson 1976]"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.common.view import Points
from mi_refgs.reference.lobe import split_sum_entry

LATTICES = (34, 55, 89, 144, 233, 377, 610, 987, 1597, 2584, 4181)
"""Fibonacci numbers: the good sizes of a rank-1 lattice with the predecessor as its generator."""
RAY_OFFSET = 1e-4  # distance by which a visibility ray starts off the surface; objects have a size of about 2
NORM_NODES = 20_000
"""Midpoints of the one-dimensional integral that normalises the prefilter's lobe: exact to 1e-8."""
GOLDEN = 0x9E3779B9  # spreads the seeds of random streams
TABLE_NODES = 700  # midpoints of the float64 quadrature of (A, B): exact to 1e-6
TABLE_COSINES = np.linspace(0.05, 1.0, 40) ** 2
"""n·v at which the quadrature is done; a cubic spline in √(n·v) lies between."""


@dataclass(frozen=True)
class Estimate:
    """Mean over batches and the standard error of that mean, both (P, 3) float64."""

    mean: np.ndarray
    error: np.ndarray

    def __add__(self, other: Estimate) -> Estimate:
        return Estimate(self.mean + other.mean, np.hypot(self.error, other.error))

    def scaled(self, factor: Any) -> Estimate:
        """Times numbers that broadcast to (P, 3)."""
        return Estimate(self.mean * factor, self.error * np.abs(factor))


def estimate(batches: np.ndarray) -> Estimate:
    """Mean of independent batches (B, P, 3), and its standard error."""
    return Estimate(batches.mean(0), batches.std(0, ddof=1) / np.sqrt(len(batches)))


@dataclass(frozen=True)
class Lobe:
    """Directions l in a frame: how to draw them, with which density, and the weights to integrate."""

    frame: Any  # mi.Frame3f
    sample: Callable[[Any], Any]  # mi.Point2f → l
    pdf: Callable[[Any], Any]
    weights: Callable[[Any], list[Any]]


# ---------------- GGX, α = roughness² ----------------


@cache
def _table_spline(roughness: float) -> Any:
    pairs = np.array([split_sum_entry(float(c), roughness, TABLE_NODES) for c in TABLE_COSINES])
    return CubicSpline(np.sqrt(TABLE_COSINES), pairs)


def exact_table(n_dot_v: np.ndarray, roughness: float) -> tuple[np.ndarray, np.ndarray]:
    """(A, B) (P, 1) each, by float64 quadrature of the reference implementation."""
    a, b = _table_spline(roughness)(np.sqrt(np.clip(n_dot_v, TABLE_COSINES[0], 1))).T
    return a[:, None], b[:, None]


def brdf_lobe(points: Points, α: Any) -> Lobe:
    """GGX reflectance in two parts, (1 - Fc) f cosθ and Fc f cosθ, for F = F0 (1 - Fc) + Fc.

    f cosθ without Fresnel = D G₂ / (4 n·v), with Smith's height-correlated 1/G₂ = 1/G₁(v) + 1/G₁(l) - 1."""
    frame = mi.Frame3f(points.normal)
    view, ggx = frame.to_local(points.view), mi.MicrofacetDistribution(mi.MicrofacetType.GGX, α)

    def weights(light: Any) -> list[Any]:
        half, lit = dr.normalize(view + light), light.z > 0
        below = dr.rcp(ggx.smith_g1(view, half)) + dr.rcp(ggx.smith_g1(light, half)) - 1
        value = dr.select(lit, ggx.eval(half) / (4 * view.z * below), 0)
        schlick = dr.power(dr.clip(1 - dr.dot(view, half), 0, 1), 5)
        return [value * (1 - schlick), value * schlick]

    def pdf(light: Any) -> Any:
        half = dr.normalize(view + light)
        return ggx.pdf(view, half) / (4 * dr.dot(view, half))

    return Lobe(frame, lambda u: mi.reflect(view, ggx.sample(view, u)[0]), pdf, weights)


def prefilter_lobe(points: Points, roughness: float, α: Any) -> Lobe:
    """The lobe of a prefiltered map: N = V = R, weight max(L·R, 0) D(H), normalised. [Karis 2013]"""
    frame = mi.Frame3f(mi.reflect(points.view, points.normal))
    ggx = mi.MicrofacetDistribution(mi.MicrofacetType.GGX, α, sample_visible=False)
    up = mi.Vector3f(0, 0, 1)
    # ∫ D cosθ_l dω_l = ∫ 4 cosθ_l (D cosθ_h dω_h), and D cosθ_h dω_h = d(ξ) with tan²θ_h = α² ξ / (1 - ξ).
    ξ = (np.arange(NORM_NODES) + 0.5) / NORM_NODES
    light_cosine = 2 / (1 + roughness**4 * ξ / (1 - ξ)) - 1
    norm = dr.opaque(mi.Float, 4 * float(np.maximum(light_cosine, 0).mean()))

    def density(light: Any) -> Any:
        return ggx.eval(dr.normalize(up + light))

    return Lobe(
        frame,
        lambda u: mi.reflect(up, ggx.sample(up, u)[0]),
        lambda light: 0.25 * density(light),
        lambda light: [dr.maximum(light.z, 0) * density(light) / norm],
    )


def cosine_lobe(points: Points) -> Lobe:
    """max(cosθ, 0)/π around the normal: irradiance over π."""

    def pdf(light: Any) -> Any:
        return dr.maximum(light.z, 0) * dr.inv_pi

    return Lobe(
        mi.Frame3f(points.normal), mi.warp.square_to_cosine_hemisphere, pdf, lambda light: [pdf(light)]
    )


# ---------------- integration ----------------


def radiance(emitter: Any, direction: Any) -> Any:
    """Radiance of an environment emitter from unit world directions."""
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(direction))
    si.wi = -direction
    return emitter.eval(si)


def predecessor(samples: int) -> int:
    """The Fibonacci number before another."""
    return round(samples / 1.618033988749895)


def lattice(i: Any, count: Any, generator: Any, shift: Any) -> Any:
    """Point i of `count` in the unit square, shifted; the generator is the count's predecessor."""
    u = shift + mi.Point2f(mi.Float(i) + 0.5, mi.Float((i * generator) % count) + 0.5) / mi.Float(count)
    return u - dr.floor(u)


def integrate(
    make_lobe: Callable[[Points], Lobe],
    points: Points,
    emitter: Any,
    *,
    samples: int = 610,
    batches: int = 8,
    seed: int = 0,
    occluder: Any = None,
) -> list[np.ndarray]:
    """∫ L(l) weight(l) dω for each weight of the lobe: arrays (batches, P, 3).

    Args:
        emitter: an environment emitter of a loaded scene.
        samples: of the lobe, and as many of the light; a member of LATTICES.
        occluder: a scene that blocks light, or None."""
    lane = dr.arange(mi.UInt32, batches * points.count)
    every = points.gather(lane % points.count)
    lobe = make_lobe(every)
    state = dr.opaque(mi.UInt32, 1 + seed)
    rng = mi.PCG32(initstate=mi.UInt64(lane) + mi.UInt64(state) * GOLDEN, initseq=mi.UInt64(state))
    shift = [mi.Point2f(rng.next_float32(), rng.next_float32()) for _ in range(2)]
    count, generator = dr.opaque(mi.UInt32, samples), dr.opaque(mi.UInt32, predecessor(samples))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(lane))
    si.p = every.position
    origin = every.position + RAY_OFFSET * every.offset
    sums = len(lobe.weights(mi.Vector3f(0, 0, 1)))

    def visible(direction: Any) -> Any:
        return True if occluder is None else ~occluder.ray_test(mi.Ray3f(origin, direction))

    def body(i: Any, *total: Any) -> tuple[Any, ...]:
        new = list(total)

        def add(light: Any, radiance_: Any, density: Any, free: Any) -> None:
            for k, weight in enumerate(lobe.weights(light)):
                share = dr.select(free & (density > 0), weight / density, 0)
                new[k] = new[k] + radiance_ * share

        light = lobe.sample(lattice(i, count, generator, shift[0]))
        world = lobe.frame.to_world(light)
        si.wi = -world
        ds = dr.zeros(mi.DirectionSample3f)
        ds.d = world
        density = lobe.pdf(light) + emitter.pdf_direction(si, ds)
        add(light, radiance(emitter, world), density, visible(world))

        ds, ratio = emitter.sample_direction(si, lattice(i, count, generator, shift[1]))
        light = lobe.frame.to_local(ds.d)
        density = lobe.pdf(light) + ds.pdf
        add(light, ratio * ds.pdf, density, (ds.pdf > 0) & visible(ds.d))
        return (i + 1, *new)

    start = (mi.UInt32(0), *(dr.zeros(mi.Color3f, dr.width(lane)) for _ in range(sums)))
    _, *total = dr.while_loop(start, lambda i, *_: i < count, body)
    dr.eval(total)
    return [np.array(t, np.float64).T.reshape(batches, points.count, 3) / samples for t in total]
