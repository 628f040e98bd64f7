"""Decompose the error of the specular term in concave scenes, up to the path tracer at full depth.

The image by the paper's rule is V(r) L(r) S + (1 - V(r)) I(r) S: free light L as prefiltered, visibility V
and indirect light I along the one mirror direction r. What is exact is the integral of the reflectance w over
all directions l of the lobe, ∫ w V L + ∫ w (1 - V) I. Between the two, in this order:

- V(r) gives way to the exact share of the lobe that is free, of which its rays are estimates;
- I(r) to the mean of the same spherical harmonics over the blocked directions of the lobe;
- the spherical harmonics in them to the true light;
- the split sum of the free light to its integral, as if nothing stood in the way;
- and the product of that and the visibility to the integral of their product.

Spherical harmonics have a value wherever the mirror ray is free, and true indirect light has none there: so
visibility goes first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.errors import Step, decompose, noise_floor
from benchmarks.common.view import Points, rows
from benchmarks.visibility.cases import PAPER, Rule
from benchmarks.visibility.setup import Setup
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.points import reflect
from mi_refgs.shade.sh import clamp_positive, eval_sh, sh_basis
from mi_refgs.surfels.attributes import MAX_SH_DEGREE

MIRROR = "mirror-ray visibility"
DIRECTION = "one direction of indirect light"
HARMONICS = "indirect light by spherical harmonics"
SPLIT = "split sum of the free light"
APART = "visibility apart from the light"
RAY = "one mirror ray for the lobe"
HIT = "split sum at the hit"
FURTHER = "no further reflections"
"""The approximations, by what is left out."""


@dataclass(frozen=True)
class Exact:
    """At P points: the free share of the reflectance (P, 3), and light by where it comes from."""

    visibility: np.ndarray
    free: mc.Estimate  # as if nothing stood in the way
    direct: mc.Estimate  # past what does
    indirect: mc.Estimate  # after further reflections

    @property
    def whole(self) -> np.ndarray:
        """The reference (P, 3)."""
        return self.direct.mean + self.indirect.mean


@dataclass(frozen=True)
class FittedHarmonics:
    """Indirect light by SH: along the mirror direction, and ∫ w (1 - V) I over the lobe (P, 3)."""

    mirror: np.ndarray
    lobe: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]  # `mirror` by either half of the samples


@dataclass(frozen=True)
class Shipped:
    """The product's images (P, 3)."""

    free: np.ndarray  # the split sum, nothing in the way
    reflectance: np.ndarray  # S
    paper: np.ndarray  # mirror ray, spherical harmonics


@dataclass(frozen=True)
class Traced:
    """Traced light of some bounces (P, 3): the product's images, and the path tracer's indirect light."""

    ray: np.ndarray  # by the mirror ray
    lobe: np.ndarray  # by many specular-lobe samples
    indirect: np.ndarray  # after as many further reflections


def by_harmonics(shipped: Shipped, exact: Exact, fitted: FittedHarmonics) -> list[Step]:
    """From the paper's rule to the reference."""
    visible = exact.visibility * shipped.free
    blocked = (1 - exact.visibility) * shipped.reflectance
    return [
        Step("", shipped.paper),
        Step(MIRROR, visible + blocked * fitted.mirror),
        Step(DIRECTION, visible + fitted.lobe),
        Step(HARMONICS, visible + exact.indirect.mean),
        *_split_sum(exact),
    ]


def by_tracing(shipped: Shipped, exact: Exact, traced: Traced) -> list[Step]:
    """From the mirror ray with traced light to the reference."""
    visible = exact.visibility * shipped.free
    return [
        Step("", traced.ray),
        Step(RAY, traced.lobe),
        Step(HIT, visible + traced.indirect),
        Step(FURTHER, visible + exact.indirect.mean),
        *_split_sum(exact),
    ]


def _split_sum(exact: Exact) -> list[Step]:
    """What both end with."""
    return [Step(SPLIT, exact.visibility * exact.free.mean + exact.indirect.mean), Step(APART, exact.whole)]


def budgets(
    setup: Setup, roughness: float, references: Mapping[str, np.ndarray], depth: int
) -> list[dict[str, Any]]:
    """The budgets of a scene, for JSON: by spherical harmonics, and by few and many bounces of traced light.

    `references` are the path tracer's batches at depths 2 ("direct") and `depth` ("full"). `floor` is what
    their noise may be all of.
    """
    fitted, exact = fit(setup, depth), exact_light(setup, references)
    shipped = Shipped(setup.image(Rule(0)), reflectance(setup), setup.image(PAPER, fitted.mirror))
    # Half the difference of two images of half the samples each is one standard error of that of all.
    first, second = (setup.image(PAPER, half) for half in fitted.halves)
    chains = {"harmonics": (by_harmonics(shipped, exact, fitted), 0.5 * (first - second))}
    for bounces in sorted({setup.settings.bounces[0], setup.settings.bounces[-1]}):
        light = (setup.reference(2 + bounces) - references["direct"]).mean(0)
        traced = Traced(
            setup.image(Rule(1, bounces)), setup.image(Rule(setup.settings.counts[-1], bounces)), light
        )
        chains[bounces_name(bounces)] = by_tracing(shipped, exact, traced), np.zeros_like(light)
    return [
        {
            "scene": setup.name,
            "roughness": roughness,
            "indirect": name,
            "floor": noise_floor(np.hypot(exact.indirect.error, noise), exact.whole),
            **decompose(steps),
        }
        for name, (steps, noise) in chains.items()
    ]


def bounces_name(bounces: int) -> str:
    """Steps of a budget with traced light."""
    return f"{bounces} bounce{'s' * (bounces > 1)}"


# ---------------- what goes in ----------------


def exact_light(setup: Setup, batches: Mapping[str, np.ndarray]) -> Exact:
    """By quadrature, and by the path tracer's images: batches (B, P, 3) of each depth, of equal seeds.

    The random numbers of two depths are the same: their images differ by the added reflections alone.
    """
    environment = setup.scene.environment()
    blocked, open_ = (setup.reflected(setup.constant, scene).mean(0) for scene in (setup.scene, None))
    return Exact(
        blocked / open_,
        mc.estimate(setup.reflected(environment, None)),
        mc.estimate(setup.reflected(environment, setup.scene)),
        mc.estimate(batches["full"] - batches["direct"]),
    )


def fit(setup: Setup, depth: int) -> FittedHarmonics:
    """The best spherical harmonics for the light of the path tracer's `max_depth`, looked up."""
    settings, points = setup.settings, setup.points
    parts = [
        traced(setup.scene, points, depth, settings.lattice, seed) for seed in range(1, settings.batches + 1)
    ]
    mirror = reflect(points.view, points.normal)
    whole, even, odd = (solve(some) for some in (parts, parts[::2], parts[1::2]))
    looked_up, first, second = (rows(along(coefficients, mirror)) for coefficients in (whole, even, odd))
    light = HarmonicsEmitter(whole)
    open_, free = (setup.reflected(light, scene).mean(0) for scene in (None, setup.scene))
    return FittedHarmonics(looked_up, open_ - free, (first, second))


def reflectance(setup: Setup) -> np.ndarray:
    """S of the product's table (P, 3)."""
    points = setup.points
    scale, bias = split_sum(dr.dot(points.normal, points.view), setup.roughness)
    return setup.albedo * np.array(scale, np.float64)[:, None] + np.array(bias, np.float64)[:, None]


DEGREE = MAX_SH_DEGREE
"""SH degree of the product's indirect channel."""
RIDGE = 1e-3
"""Penalty on the coefficients, in multiples of what all directions of a hemisphere weigh: it decides where
hardly any direction is blocked. From 1e-4 to 1e-2 the relMSE of the image changes by less than a tenth in
the bowls and for rough plates; for plates of roughness 0.1 it goes from 0.04 to 0.08, and is 0.06 here."""


Sums = tuple[np.ndarray, np.ndarray]
"""Sums of the least squares at P points, K coefficients: A'A (P, K, K), A'b (P, K, 3) per direction."""


def solve(parts: list[Sums]) -> np.ndarray:
    """Coefficients (P, K, 3) from batches of equally many directions."""
    normal, right = (np.mean(found, axis=0) for found in zip(*parts, strict=True))
    # The basis is orthonormal: its mean square over directions is 1/4π.
    return np.linalg.solve(normal + RIDGE / (4 * np.pi) * np.eye(normal.shape[-1]), right)


def sums(basis: np.ndarray, radiance: np.ndarray, blocked: np.ndarray) -> Sums:
    """Sample D directions: basis (P, D, K), radiance (P, D, 3), blocked (P, D)."""
    columns = np.swapaxes(basis * blocked[..., None], 1, 2)
    normal, right = ((columns @ values).astype(np.float64) / basis.shape[1] for values in (basis, radiance))
    return normal, right


def traced(scene: Any, points: Points, depth: int, directions: int, seed: int) -> Sums:
    """One path of Mitsuba's `path` into each direction of a lattice that every point shifts at random.

    `depth` is the `max_depth` of the image that this light is a part of: one reflection, at the point, is
    behind the path already. `directions` is one of `montecarlo.LATTICES`.
    """
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


class HarmonicsEmitter:
    """SH at each of P points as an emitter for `montecarlo.integrate`, which is never sampled itself.

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
