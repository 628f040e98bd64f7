"""The error of the specular term in concave scenes taken apart, up to the path tracer at full depth.

The picture by the paper's rule is V(r) L(r) S + (1 - V(r)) I(r) S: free light L as prefiltered, visibility V
and indirect light I along the one mirror direction r. What is exact is the integral of the reflectance w over
all directions l of the lobe, ∫ w V L + ∫ w (1 - V) I. Between the two, in this order:

- V(r) gives way to the exact share of the lobe that is free, of which its rays are estimates;
- I(r) to the mean of the same harmonics over the blocked directions of the lobe;
- the harmonics in them to the true light;
- the split sum of the free light to its integral, as if nothing stood in the way;
- and the product of that and the visibility to the integral of their product.

Harmonics have a value wherever the mirror ray is free, and true indirect light has none there: so visibility
goes first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.budget import Step, decompose, noise_floor
from benchmarks.common.view import rows
from benchmarks.visibility import harmonics
from benchmarks.visibility.settings import PAPER, Rule, Settings
from benchmarks.visibility.setup import Setup
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.points import reflect

MIRROR = "mirror-ray visibility"
DIRECTION = "one direction of indirect light"
HARMONICS = "indirect light by harmonics"
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
class TrainedScene:
    """Indirect light by harmonics: along the mirror direction, and ∫ w (1 - V) I over the lobe (P, 3)."""

    mirror: np.ndarray
    lobe: np.ndarray
    halves: tuple[np.ndarray, np.ndarray]  # `mirror` by either half of the samples


@dataclass(frozen=True)
class Shipped:
    """The product's pictures (P, 3)."""

    free: np.ndarray  # the split sum, nothing in the way
    reflectance: np.ndarray  # S
    paper: np.ndarray  # mirror ray, harmonics


@dataclass(frozen=True)
class Traced:
    """Traced light of some bounces (P, 3): the product's pictures, and the path tracer's indirect light."""

    ray: np.ndarray  # by the mirror ray
    lobe: np.ndarray  # by many rays of the lobe
    indirect: np.ndarray  # after as many further reflections


def by_harmonics(shipped: Shipped, exact: Exact, fitted: TrainedScene) -> list[Step]:
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


def bounces_shown(settings: Settings) -> list[int]:
    """Numbers of traced bounces that have a budget."""
    return sorted({settings.bounces[0], settings.bounces[-1]})


def budgets(
    setup: Setup, roughness: float, references: Mapping[str, np.ndarray], depth: int
) -> list[dict[str, Any]]:
    """The budgets of a scene, for JSON: by harmonics, and by few and many bounces of traced light.

    `references` are the path tracer's batches at depths 2 ("direct") and `depth` ("full"). `floor` is what
    their noise may be all of.
    """
    fitted, exact = fit(setup, depth), exact_light(setup, references)
    shipped = Shipped(setup.picture(Rule(0)), reflectance(setup), setup.picture(PAPER, fitted.mirror))
    # Half the difference of two pictures of half the samples each is one standard error of that of all.
    first, second = (setup.picture(PAPER, half) for half in fitted.halves)
    chains = {"harmonics": (by_harmonics(shipped, exact, fitted), 0.5 * (first - second))}
    for bounces in bounces_shown(setup.settings):
        light = (setup.reference(2 + bounces) - references["direct"]).mean(0)
        traced = Traced(
            setup.picture(Rule(1, bounces)), setup.picture(Rule(setup.settings.counts[-1], bounces)), light
        )
        chains[bounces_name(bounces)] = by_tracing(shipped, exact, traced), np.zeros_like(light)
    return [
        {
            "scene": setup.name,
            "roughness": roughness,
            "indirect": name,
            "floor": noise_floor(np.hypot(exact.indirect.error, noise), exact.whole),
            **decompose(steps).record(),
        }
        for name, (steps, noise) in chains.items()
    ]


def bounces_name(bounces: int) -> str:
    """Of a budget with traced light."""
    return f"{bounces} bounce{'s' * (bounces > 1)}"


# ---------------- what goes in ----------------


def exact_light(setup: Setup, batches: Mapping[str, np.ndarray]) -> Exact:
    """By quadrature, and by the path tracer's pictures: batches (B, P, 3) of each depth, of equal seeds.

    The random numbers of two depths are the same: their pictures differ by the added reflections alone.
    """
    environment = setup.scene.environment()
    blocked, open_ = (setup.reflected(setup.constant, scene).mean(0) for scene in (setup.scene, None))
    return Exact(
        blocked / open_,
        mc.estimate(setup.reflected(environment, None)),
        mc.estimate(setup.reflected(environment, setup.scene)),
        mc.estimate(batches["full"] - batches["direct"]),
    )


def fit(setup: Setup, depth: int) -> TrainedScene:
    """The best harmonics for the light of the path tracer's `max_depth`, looked up."""
    settings, points = setup.settings, setup.points
    parts = [
        harmonics.traced(setup.scene, points, depth, settings.lattice, seed)
        for seed in range(1, settings.batches + 1)
    ]
    mirror = reflect(points.view, points.normal)
    whole, even, odd = (harmonics.mean(some).solve() for some in (parts, parts[::2], parts[1::2]))
    looked_up, first, second = (
        rows(harmonics.along(coefficients, mirror)) for coefficients in (whole, even, odd)
    )
    light = harmonics.Surroundings(whole)
    open_, free = (setup.reflected(light, scene).mean(0) for scene in (None, setup.scene))
    return TrainedScene(looked_up, open_ - free, (first, second))


def reflectance(setup: Setup) -> np.ndarray:
    """S of the product's table (P, 3)."""
    points = setup.points
    scale, bias = split_sum(dr.dot(points.normal, points.view), setup.roughness)
    return setup.albedo * np.array(scale, np.float64)[:, None] + np.array(bias, np.float64)[:, None]
