"""One object under one light: Mitsuba's scene, its points, and what every method is compared on."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.view import Light, Look, Points, first_hits, make_sensor, surface
from mi_refgs.surfels.attributes import logit
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels

ALBEDO = (0.9, 0.6, 0.3)
OPACITY = 0.99  # opacity of surfels that cover a solid surface


def path_tracer(depth: int, type: str = "path", hide: bool = False) -> Any:
    """Mitsuba's, without Russian roulette: images of two depths differ by their reflections alone."""
    return mi.load_dict({"type": type, "max_depth": depth, "rr_depth": 1000, "hide_emitters": hide})


class Setup:
    """A shape (a dictionary of Mitsuba's) under a light; `settings`: size, timing_size, lattice, batches."""

    def __init__(self, name: str, shape: dict[str, Any], light: Light, look: Look, settings: Any) -> None:
        self.name, self.settings, self.albedo = name, settings, np.array(ALBEDO)
        colour = {"type": "rgb", "value": list(ALBEDO)}
        bsdf = {"type": "refgs_bsdf", "albedo": colour, "metallic": 0.5, "roughness": 0.3}
        scene = {"type": "scene", "shape": shape | {"bsdf": bsdf}, "light": light.emitter()}
        self.scene = mi.load_dict(scene)
        self.emitter = self.scene.environment()
        self.params = mi.traverse(self.scene)
        self.sensor = make_sensor(look, settings.size)
        self.timing_sensor = make_sensor(look, settings.timing_size)
        self.points = surface(self.scene, self.sensor, settings.size)

    def set_material(self, metallic: float, roughness: float) -> dict[str, Any]:
        """Set the surface's material; return it on the device, opaque: another one compiles no new kernel."""
        self.params["shape.bsdf.metallic.value"] = metallic
        self.params["shape.bsdf.roughness.value"] = roughness
        self.params.update()
        return {
            "albedo": mi.Color3f(*(dr.opaque(mi.Float, float(x)) for x in self.albedo)),
            "metallic": dr.opaque(mi.Float, metallic),
            "roughness": dr.opaque(mi.Float, roughness),
        }

    def render(self, integrator: Any, spp: int, seed: int) -> np.ndarray:
        """Mitsuba's image (P, 3)."""
        image = mi.render(self.scene, sensor=self.sensor, integrator=integrator, spp=spp, seed=seed)
        return self.points.of_image(image)

    def integrate(self, lobe: Any, emitter: Any, occluder: Any = None, seed: int = 0) -> list[np.ndarray]:
        """`montecarlo.integrate` at the points: batches (B, P, 3) of each weight of the lobe."""
        counts = {"samples": self.settings.lattice, "batches": self.settings.batches}
        return mc.integrate(lobe, self.points, emitter, **counts, seed=seed, occluder=occluder)

    def with_primary_rays(self, shader: Callable[[Points], Any]) -> Callable[[], Any]:
        """A call that meets the surface at the centre of every pixel of the timed image and shades it."""
        size = self.settings.timing_size

        def run() -> Any:
            hit, ray = first_hits(self.scene, self.timing_sensor, size)
            pixel = dr.arange(mi.UInt32, size * size)
            colour = shader(Points(size, pixel, hit.p, hit.sh_frame.n, -ray.d, hit.n))
            return dr.select(hit.is_valid(), colour, 0)

        return run


def covering(points: np.ndarray, normals: np.ndarray, **material: Any) -> Surfels:
    """Nearly opaque surfels at points (N, 3); albedo, metallic and roughness broadcast to (N, D)."""
    raw = from_points(points, normals, rng=np.random.default_rng(0), opacity=OPACITY).to_numpy()
    for name, values in material.items():
        raw[name] = np.broadcast_to(logit(values), raw[name].shape).astype(np.float32)
    return Surfels.from_numpy(raw)
