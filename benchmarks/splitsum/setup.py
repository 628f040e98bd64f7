"""Settings, shapes and cameras; set-ups with the exact integrals of every roughness, and their split sums."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.montecarlo import Estimate
from benchmarks.common.setup import ALBEDO, Setup, path_tracer
from benchmarks.common.view import BUILT_IN, ROOT, Light, Look, Points
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance.split_sum import SplitSum

MESHES = ROOT / "scenes" / "meshes"

SHAPES: dict[str, Look] = {
    "sphere": Look((0, 0.6, 4), (0, 0, 0), 30),
    "rounded_cube": Look((1.6, 1.2, 3.4), (0, 0, 0), 33),
    "patch": Look((0, 1, 0), (-1, 0.8, 0), 18),  # a floor from 2° to 20° above it, looking at the low sun
    "torus": Look((0, -2.4, 2.6), (0, 0, 0), 36),
}
"""The cameras of the shapes. All are convex but the torus, which shadows and mirrors itself."""
CONVEX = ("sphere", "rounded_cube", "patch")


def shape(name: str) -> dict[str, Any]:
    """Mitsuba's description of a shape."""
    if name == "sphere":
        return {"type": "sphere"}
    if name == "patch":
        turn = mi.ScalarTransform4f().rotate([1, 0, 0], -90) @ mi.ScalarTransform4f().scale(100)
        return {"type": "rectangle", "to_world": turn}
    return {"type": "ply", "filename": str(MESHES / f"{name}.ply")}


@dataclass(frozen=True)
class Settings:
    """One run; heights and sample counts rise."""

    shapes: tuple[str, ...] = ("sphere", "rounded_cube", "patch")
    lights: tuple[str, ...] = BUILT_IN
    roughness: tuple[float, ...] = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8, 1.0)
    metallic: tuple[float, ...] = (0.0, 0.5, 1.0)
    size: int = 48  # edge of the images whose error is measured
    timing_size: int = 512  # of those that are timed: large enough that launching a kernel costs nothing
    truth_height: int = 512
    heights: tuple[int, ...] = (16, 32, 64, 128, 256)
    spp: tuple[int, ...] = (1, 4, 16, 64)
    timed_spp: tuple[int, ...] = (1, 4, 16)
    lattice: int = 377  # points of the reference's lattices, and as many of the light
    batches: int = 8
    budget_shapes: tuple[str, ...] = ("sphere", "patch", "torus")
    budget_metallic: tuple[float, ...] = (0.0, 1.0)
    full_depth_spp: int = 256
    timing_seconds: float = 0.25  # spent on each time, at least
    timing_rounds: int = 25  # of each time, at most


PAGE = Settings()
SMALL = Settings(
    shapes=("sphere", "patch"),
    lights=("constant", "gradient", "checker", "sunsky"),
    roughness=(0.1, 0.3, 0.8),
    metallic=(0.5,),
    size=24,
    timing_size=32,
    truth_height=64,
    heights=(16, 64),
    spp=(1, 4, 16),
    timed_spp=(1, 4),
    lattice=233,
    budget_shapes=("sphere", "torus"),
    budget_metallic=(1.0,),
    full_depth_spp=16,
    timing_seconds=0.01,
    timing_rounds=1,
)
FULL_DEPTH = 8


def split_sum(points: Points, material: dict[str, Any], light: Any, dominant: bool = False) -> Any:
    """Outgoing radiance (mi.Color3f) as the product shades it."""
    options = ShadingOptions(diffuse="irradiance", dominant=dominant)
    return SplitSum().shade(ShadingPoints(points.normal, points.view, **material), light, options).total()


@dataclass(frozen=True)
class Integrals:
    """At P points, for one roughness: ∫ L (1 - Fc) f cosθ, ∫ L Fc f cosθ, and irradiance over π."""

    scale: Estimate
    bias: Estimate
    irradiance: Estimate
    table: tuple[np.ndarray, np.ndarray]  # (A, B), (P, 1) each: the first two under a constant light of 1

    def radiance(self, metallic: float) -> Estimate:
        """Outgoing radiance: the integrals do not depend on F0 and albedo: one set is used for every metal.

        Both specular integrals come from the same samples: their errors add, not the squares."""
        f0, scale, bias = reflectance(metallic), self.scale, self.bias
        specular = Estimate(f0 * scale.mean + bias.mean, f0 * scale.error + bias.error)
        return specular + self.irradiance.scaled(diffuse(metallic, self.table))


def reflectance(metallic: float) -> np.ndarray:
    """F0 (3,)."""
    return 0.04 * (1 - metallic) + np.array(ALBEDO) * metallic


def diffuse(metallic: float, table: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Diffuse reflectance (P, 3) of points with these (A, B): of what the specular term leaves."""
    scale, bias = table
    return (1 - reflectance(metallic) * scale - bias) * (1 - metallic) * np.array(ALBEDO)


class Exact(Setup):
    """One shape under one light, with references that are made when asked for and kept."""

    def __init__(self, name: str, light: Light, settings: Settings) -> None:
        super().__init__(name, shape(name), light, SHAPES[name], settings)
        self.light = light
        self.bounces = functools.cache(self._bounces)
        self.integrals = functools.cache(self._integrals)
        self.irradiance = functools.cache(self._irradiance)

    def case(self, roughness: float, metallic: float) -> dict[str, Any]:
        """What a row of a report says of its place."""
        return {"shape": self.name, "light": self.light.name, "roughness": roughness, "metallic": metallic}

    def _integrals(self, roughness: float, occluded: bool = False) -> Integrals:
        """The exact integrals, without or with the shape's own shadow."""
        α, seed = dr.opaque(mi.Float, roughness**2), 2 + round(1000 * roughness)
        scale, bias = self._estimates(lambda points: mc.brdf_lobe(points, α), seed, occluded)
        table = mc.exact_table(self.points.n_dot_v(), roughness)
        return Integrals(scale, bias, self.irradiance(occluded), table)

    def _irradiance(self, occluded: bool) -> Estimate:
        return self._estimates(mc.cosine_lobe, 1, occluded)[0]

    def prefiltered(self, roughness: float) -> Estimate:
        """Radiance averaged over the lobe with N = V = R around the mirror direction, exactly."""
        α = dr.opaque(mi.Float, roughness**2)
        return self._estimates(lambda points: mc.prefilter_lobe(points, roughness, α), 3, False)[0]

    def _estimates(self, lobe: Any, seed: int, occluded: bool) -> list[Estimate]:
        occluder = self.scene if occluded else None
        return [mc.estimate(batches) for batches in self.integrate(lobe, self.emitter, occluder, seed)]

    def _bounces(self, roughness: float, metallic: float) -> np.ndarray:
        """Radiance (P, 3) that the shape reflects onto itself, by the path tracer.

        The same random numbers with and without further bounces: the difference is those bounces alone."""
        self.set_material(metallic, roughness)
        full, direct = (self.render(path_tracer(n), self.settings.full_depth_spp, 1) for n in (FULL_DEPTH, 2))
        return full - direct
