"""Set-ups: one concave scene under the light, its pictures by each rule and by the path tracer."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from benchmarks.common import montecarlo as mc
from benchmarks.common.lights import make_light
from benchmarks.common.view import Points, first_hits, make_sensor, surface
from benchmarks.visibility.rules import Rule
from benchmarks.visibility.scenes import Concave
from benchmarks.visibility.settings import ALBEDO, METALLIC, VOXEL, Settings
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import render
from mi_refgs.shade.points import ShadingPoints
from mi_refgs.shade.reflectance import Surroundings
from mi_refgs.shade.reflection import reflection
from mi_refgs.shade.shading import Shading
from mi_refgs.shade.split_sum import shade
from mi_refgs.splat import Camera
from mi_refgs.surfels.channels import logit
from mi_refgs.surfels.init import from_points
from mi_refgs.surfels.table import Surfels

EXTREME = 1e-6
"""Distance of albedo and metallic from 1, which their activation cannot reach."""
OPACITY = 0.99
TIMED_ROUGHNESS = 0.3


class Setup:
    """One concave scene under the light."""

    def __init__(
        self,
        concave: Concave,
        settings: Settings,
        light_name: str = "studio",
        albedo: tuple[float, float, float] = ALBEDO,
    ) -> None:
        light = make_light(light_name, settings.light_height)
        self.name, self.settings, self.albedo = concave.name, settings, np.array(albedo)
        self.scene = concave.load(light.emitter(), albedo)
        self.params = mi.traverse(self.scene)
        constant = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "ball": {"type": "sphere"}})
        self.constant = constant.environment()
        self.light = light.prefiltered(settings.light_height)
        self.sensor = make_sensor(concave.look, settings.size)
        self.timing_sensor = make_sensor(concave.look, settings.timing_size)
        self.points = surface(self.scene, self.sensor, settings.size)
        self.origin = mi.Point3f(concave.look.origin)
        mesh = concave.mesh
        vertices, faces = np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32)
        self.occluder = Occluder(Mesh(vertices, faces, VOXEL))
        self.vertices, self.normals = vertices, np.array(mesh.vertex_normals, np.float32)
        self.surfels = self.material(TIMED_ROUGHNESS)
        self.occluder.set_materials(self.surfels)

    def material(self, roughness: float) -> Surfels:
        """Give the scene this roughness; surfels at the mesh's vertices, of the same material."""
        self.roughness = dr.opaque(mi.Float, roughness)
        self.params["shape.bsdf.roughness.value"] = roughness
        self.params.update()
        rng = np.random.default_rng(0)
        raw = from_points(self.vertices, self.normals, rng=rng, opacity=OPACITY).to_numpy()
        count = len(self.vertices)
        raw["albedo"] = np.tile(logit(np.minimum(self.albedo, 1 - EXTREME)), (count, 1)).astype(np.float32)
        raw["metallic"] = np.full((count, 1), logit(np.array(1 - EXTREME)), np.float32)
        raw["roughness"] = np.full((count, 1), logit(np.array(roughness)), np.float32)
        self.surfels = Surfels.from_numpy(raw)
        return self.surfels

    def seen(self, points: Points, rule: Rule) -> ShadingPoints:
        """The points with what the rule finds."""
        albedo = mi.Color3f(*(dr.opaque(mi.Float, float(x)) for x in self.albedo))
        metallic = dr.opaque(mi.Float, METALLIC)
        at = ShadingPoints(
            points.normal, points.view, albedo=albedo, metallic=metallic, roughness=self.roughness
        )
        if not rule.rays:
            return at
        around = Surroundings(self.occluder, self.surfels, self.light, self.origin, -points.view)
        return reflection(at, around, "irradiance", rule.accuracy())

    def shaded(self, points: Points, rule: Rule) -> Any:
        """Outgoing radiance (mi.Color3f)."""
        return shade(self.seen(points, rule), self.light, "irradiance", rule.accuracy()).total()

    def picture(self, rule: Rule, indirect: np.ndarray | None = None) -> np.ndarray:
        """(P, 3); with indirect light (P, 3) of blocked rays in place of the rule's own."""
        at = self.seen(self.points, rule)
        if indirect is not None:
            at = at.replaced(indirect=mi.Color3f(np.ascontiguousarray(indirect.T, np.float32)))
        shaded = shade(at, self.light, "irradiance", rule.accuracy())
        return np.array(shaded.total(), np.float64).T

    def reference(self, depth: int) -> np.ndarray:
        """The path tracer's pictures: batches (B, P, 3), whose random numbers are those of other depths."""
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
        batches = [
            self.points.of_image(
                mi.render(
                    self.scene, sensor=self.sensor, integrator=integrator, spp=self.settings.spp, seed=seed
                )
            )
            for seed in range(1, self.settings.batches + 1)
        ]
        return np.stack(batches)

    def reflected(self, emitter: Any, occluder: Any) -> np.ndarray:
        """The integral of the reflectance and a light, past an occluder unless None: batches (B, P, 3)."""
        α = dr.square(self.roughness)
        scale, bias = mc.integrate(
            lambda points: mc.brdf_lobe(points, α),
            self.points,
            emitter,
            samples=self.settings.lattice,
            batches=self.settings.batches,
            occluder=occluder,
        )
        return np.asarray(self.albedo * scale + bias)

    def visibility(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean visibility over the reflectance (P,) and its standard error, by the benchmark's own code."""
        found, free = (self.reflected(self.constant, scene).mean(-1) for scene in (self.scene, None))
        blocked = found / free.mean(0)
        return blocked.mean(0), blocked.std(0, ddof=1) / np.sqrt(len(blocked))

    def shading_call(self, rule: Rule) -> Callable[[], Any]:
        """The timed picture of the mesh: a primary ray through every pixel, visibility, shading."""
        size = self.settings.timing_size

        def run() -> Any:
            hit, ray = first_hits(self.scene, self.timing_sensor, size)
            pixel = dr.arange(mi.UInt32, size * size)
            points = Points(size, pixel, hit.p, hit.sh_frame.n, -ray.d, hit.n)
            return dr.select(hit.is_valid(), self.shaded(points, rule), 0)

        return run

    def frame_call(self, rule: Rule) -> Callable[[], Any]:
        """The product's own frame: the surfels splatted, visibility, shading."""
        camera = Camera.from_sensor(self.timing_sensor.inner)
        shading = Shading(diffuse="irradiance", occlusion=rule.rays > 0, accuracy=rule.accuracy())
        return lambda: render(self.surfels, camera, shading, self.light, self.occluder).radiance
