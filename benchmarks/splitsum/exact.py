"""Set-ups: one shape under one light as Mitsuba's scene, with the exact integrals of every roughness."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.lights import Light
from benchmarks.common.montecarlo import Estimate
from benchmarks.common.view import Points, make_sensor, surface
from benchmarks.splitsum.settings import ALBEDO, SHAPES, Settings, shape


@dataclass(frozen=True)
class Integrals:
    """At P points, for one roughness: ∫ L (1 - Fc) f cosθ, ∫ L Fc f cosθ, and irradiance over π."""

    scale: Estimate
    bias: Estimate
    irradiance: Estimate
    table: tuple[np.ndarray, np.ndarray]  # (A, B), (P, 1) each: the first two under a constant light of 1

    def radiance(self, metallic: float) -> Estimate:
        """Outgoing radiance: the integrals do not depend on F0 and albedo, so one set serves every metal."""
        return self.specular(metallic) + self.irradiance.scaled(diffuse(metallic, self.table))

    def specular(self, metallic: float) -> Estimate:
        """The specular part. Both integrals come from the same samples: their errors add, not the squares."""
        f0 = reflectance(metallic)
        error = f0 * self.scale.error + self.bias.error
        return Estimate(f0 * self.scale.mean + self.bias.mean, error)


def reflectance(metallic: float) -> np.ndarray:
    """F0 (3,)."""
    return 0.04 * (1 - metallic) + np.array(ALBEDO) * metallic


def diffuse(metallic: float, table: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Diffuse reflectance (P, 3) of points with these (A, B): of what the specular term leaves."""
    return mc.left_by_specular(reflectance(metallic), *table) * (1 - metallic) * np.array(ALBEDO)


class Setup:
    """One shape under one light: scene, sensor, points, and references made when asked for and kept."""

    def __init__(self, name: str, light: Light, settings: Settings) -> None:
        self.name, self.light, self.settings = name, light, settings
        bsdf = {
            "type": "refgs_bsdf",
            "albedo": {"type": "rgb", "value": list(ALBEDO)},
            "metallic": 0.5,
            "roughness": 0.3,
        }
        self.scene = mi.load_dict(
            {"type": "scene", "shape": {**shape(name), "bsdf": bsdf}, "light": light.emitter()}
        )
        self.emitter = self.scene.environment()
        self.params = mi.traverse(self.scene)
        self.sensor = make_sensor(SHAPES[name], settings.size)
        self.timing_sensor = make_sensor(SHAPES[name], settings.timing_size)
        self.points: Points = surface(self.scene, self.sensor, settings.size)
        self.direct = mi.load_dict({"type": "path", "max_depth": 2})
        self.full = mi.load_dict({"type": "path", "max_depth": 8, "rr_depth": 100})
        self._bounces: dict[tuple[float, float], np.ndarray] = {}
        self._irradiance: dict[bool, Estimate] = {}
        self._integrals: dict[tuple[float, bool], Integrals] = {}

    def set_material(self, metallic: float, roughness: float) -> None:
        """Of the scene's surface."""
        self.params["shape.bsdf.metallic.value"] = metallic
        self.params["shape.bsdf.roughness.value"] = roughness
        self.params.update()

    def integrals(self, roughness: float, occluded: bool = False) -> Integrals:
        """The exact integrals, without or with the shape's own shadow."""
        key = (roughness, occluded)
        if key not in self._integrals:
            occluder = self.scene if occluded else None
            if occluded not in self._irradiance:
                self._irradiance[occluded] = self._integrate(mc.cosine_lobe, 1, occluder)[0]
            α = dr.opaque(mi.Float, roughness**2)
            seed = 2 + round(1000 * roughness)
            scale, bias = self._integrate(lambda points: mc.brdf_lobe(points, α), seed, occluder)
            table = mc.exact_table(self.points.n_dot_v(), roughness)
            self._integrals[key] = Integrals(scale, bias, self._irradiance[occluded], table)
        return self._integrals[key]

    def prefiltered(self, roughness: float) -> Estimate:
        """Radiance averaged over the lobe with N = V = R around the mirror direction, exactly."""
        α = dr.opaque(mi.Float, roughness**2)
        return self._integrate(lambda points: mc.prefilter_lobe(points, roughness, α), 3, None)[0]

    def bounces(self, roughness: float, metallic: float) -> np.ndarray:
        """Radiance (P, 3) that the shape reflects onto itself, by the path tracer.

        The same random numbers with and without further bounces: the difference is those bounces alone.
        """
        key = (roughness, metallic)
        if key not in self._bounces:
            self.set_material(metallic, roughness)
            spp = self.settings.full_depth_spp
            full, direct = (
                mi.render(self.scene, sensor=self.sensor, integrator=path, spp=spp, seed=1)
                for path in (self.full, self.direct)
            )
            self._bounces[key] = self.points.of_image(full) - self.points.of_image(direct)
        return self._bounces[key]

    def _integrate(self, lobe: Any, seed: int, occluder: Any) -> list[Estimate]:
        settings = self.settings
        found = mc.integrate(
            lobe,
            self.points,
            self.emitter,
            samples=settings.lattice,
            batches=settings.batches,
            seed=seed,
            occluder=occluder,
        )
        return [mc.estimate(batches) for batches in found]
