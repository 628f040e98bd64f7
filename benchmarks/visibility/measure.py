"""The experiment: the specular picture by each rule of visibility, against the path tracer at two depths."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from tqdm import tqdm

from benchmarks.common import errors, report, timing
from benchmarks.common import montecarlo as mc
from benchmarks.common.lights import make_light
from benchmarks.common.view import Points, first_hits, make_sensor, surface
from benchmarks.visibility.payoff import payoffs
from benchmarks.visibility.scenes import Concave, make_scene
from benchmarks.visibility.settings import ALBEDO, METALLIC, VOXEL, Settings
from mi_refgs.occlusion.mesh import Mesh
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.render.pipeline import Shading, render
from mi_refgs.render.reflection import reflection
from mi_refgs.shade.models import Accuracy, ShadingPoints, shade
from mi_refgs.splat import Camera
from mi_refgs.surfels.init import from_points, logit
from mi_refgs.surfels.table import Surfels

DEPTHS = {"direct": 2, "bounce": 3, "full": 12}
"""Mitsuba's `max_depth`: light after one reflection, after up to two, and after up to eleven."""
EXTREME = 1e-6
"""Distance of metallic from 1, which its activation cannot reach."""
OPACITY = 0.99
TIMED_ROUGHNESS = 0.3


@dataclass(frozen=True)
class Rule:
    """How visibility and indirect light are found; 0 rays: not at all."""

    rays: int
    traced: bool = False
    dominant: bool = False

    @property
    def name(self) -> str:
        """In the report."""
        base = {0: "no occlusion", 1: "mirror ray"}.get(self.rays, f"{self.rays} rays")
        return base + ", traced" * self.traced + ", dominant" * self.dominant

    def accuracy(self) -> Accuracy:
        """As the product is told."""
        return Accuracy(
            dominant=self.dominant, visibility_rays=max(self.rays, 1), traced_indirect=self.traced
        )


PAPER = Rule(1)
"""One mirror ray for the whole lobe, and no traced light."""


def rules(settings: Settings) -> Iterator[Rule]:
    """All that are measured."""
    yield Rule(0)
    for rays in settings.counts:
        yield Rule(rays)
    for dominant in settings.dominant:
        for rays in (1, *settings.rays) if dominant else settings.counts:
            yield Rule(rays, True, dominant)


class Stage:
    """One concave scene under the light."""

    def __init__(self, concave: Concave, settings: Settings) -> None:
        light = make_light("studio", settings.light_height)
        self.name, self.settings = concave.name, settings
        self.scene = concave.load(light.emitter())
        self.params = mi.traverse(self.scene)
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
        raw["albedo"] = np.tile(logit(np.array(ALBEDO)), (count, 1)).astype(np.float32)
        raw["metallic"] = np.full((count, 1), logit(np.array(1 - EXTREME)), np.float32)
        raw["roughness"] = np.full((count, 1), logit(np.array(roughness)), np.float32)
        self.surfels = Surfels.from_numpy(raw)
        return self.surfels

    def seen(self, points: Points, rule: Rule) -> ShadingPoints:
        """The points with what the rule finds."""
        albedo = mi.Color3f(*(dr.opaque(mi.Float, x) for x in ALBEDO))
        metallic = dr.opaque(mi.Float, METALLIC)
        at = ShadingPoints(points.normal, points.view, albedo, metallic, self.roughness)
        if not rule.rays:
            return at
        return reflection(
            self.occluder,
            self.surfels,
            self.light,
            rule.accuracy(),
            "irradiance",
            self.origin,
            -points.view,
            at,
        )

    def shaded(self, points: Points, rule: Rule) -> Any:
        """Outgoing radiance (mi.Color3f)."""
        return shade(self.seen(points, rule), self.light, "irradiance", rule.accuracy()).total()

    def picture(self, rule: Rule) -> np.ndarray:
        """(P, 3)."""
        return np.array(self.shaded(self.points, rule), np.float64).T

    def reference(self, depth: int) -> mc.Estimate:
        """The path tracer's picture, with its standard error."""
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 1000})
        batches = [
            self.points.of_image(
                mi.render(
                    self.scene, sensor=self.sensor, integrator=integrator, spp=self.settings.spp, seed=seed
                )
            )
            for seed in range(1, self.settings.batches + 1)
        ]
        return mc.estimate(np.stack(batches))

    def visibility(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean visibility over the reflectance (P,) and its standard error, by the benchmark's own code."""
        scene = mi.load_dict({"type": "scene", "light": {"type": "constant"}, "ball": {"type": "sphere"}})
        α, f0 = dr.square(self.roughness), float(np.mean(ALBEDO))
        found = []
        for occluder in (self.scene, None):
            scale, bias = mc.integrate(
                lambda points: mc.brdf_lobe(points, α),
                self.points,
                scene.environment(),
                samples=self.settings.lattice,
                batches=self.settings.batches,
                occluder=occluder,
            )
            found.append((f0 * scale + bias).mean(-1))
        blocked = found[0] / found[1].mean(0)
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
        return lambda: render(self.surfels, camera, shading, self.light, self.occluder).radiance()


def measure(settings: Settings, quiet: bool = False) -> dict[str, Any]:
    """Run it all; what comes back is the JSON report."""
    begin = time.perf_counter()
    scenes = [make_scene(name, settings.detail) for name in (*settings.scenes, *settings.meshes)]
    rows: list[dict[str, Any]] = []
    curve: list[dict[str, Any]] = []
    facts: dict[str, Any] = {}
    for concave in tqdm(scenes, desc="scenes", disable=quiet):
        stage = Stage(concave, settings)
        found: list[dict[str, Any]] = []
        for roughness in tqdm(settings.roughness, desc=stage.name, disable=quiet):
            stage.material(roughness)
            found += _errors(stage, roughness)
            curve += _curve(stage, roughness)
        times = _times(stage)
        rows += [row | times.get(row["method"], dict.fromkeys(("ms", "frame_ms"))) for row in found]
        facts[stage.name] = {
            "pixels": stage.points.count,
            "triangles": len(concave.mesh.faces),
            "surfels": stage.surfels.count,
        }
    return {
        "machine": report.machine(),
        "settings": vars(settings),
        "seconds": time.perf_counter() - begin,
        "scenes": facts,
        "rows": rows,
        "curve": curve,
        "payoffs": payoffs(rows),
    }


def _errors(stage: Stage, roughness: float) -> list[dict[str, Any]]:
    """A row for each rule and depth."""
    pictures = {rule: stage.picture(rule) for rule in rules(stage.settings)}
    rows = []
    for name, depth in DEPTHS.items():
        reference = stage.reference(depth)
        for rule, values in pictures.items():
            found = errors.compare(values, reference)
            rows.append(
                {
                    "scene": stage.name,
                    "roughness": roughness,
                    "method": rule.name,
                    **vars(rule),
                    "depth": name,
                    "bias": found.bias,
                    "bias_floor": found.bias_floor,
                    "relmse": found.relmse,
                    "relmse_floor": found.relmse_floor,
                    "below_floor": found.below_floor,
                }
            )
    return rows


def _curve(stage: Stage, roughness: float) -> list[dict[str, Any]]:
    """Over rays: distance of the visibility to the exact one, and of the picture to that of many rays."""
    exact, noise = stage.visibility()
    limit = stage.picture(Rule(stage.settings.limit, traced=True))
    weight = errors.weight(limit)
    found = []
    for rays in (*stage.settings.counts, stage.settings.limit):
        visibility = np.array(stage.seen(stage.points, Rule(rays)).visibility, np.float64)
        picture = stage.picture(Rule(rays, traced=True))
        found.append(
            {
                "scene": stage.name,
                "roughness": roughness,
                "rays": rays,
                "visibility_rms": float(np.sqrt(np.mean((visibility - exact) ** 2))),
                "visibility_floor": float(np.sqrt(np.mean(noise**2))),
                "visibility_bias": float(np.mean(visibility - exact)),
                "to_limit": float(np.mean((picture - limit) ** 2 * weight)),
            }
        )
    return found


def _times(stage: Stage) -> dict[str, dict[str, float]]:
    """Milliseconds of each rule that is timed, by name: shading alone, and the product's frame."""
    stage.material(TIMED_ROUGHNESS)
    timed = [rule for rule in rules(stage.settings) if rule.rays in (0, 1, *stage.settings.rays)]
    seconds = stage.settings.timing_seconds
    shading, frame = (
        timing.milliseconds({rule.name: make(rule) for rule in timed}, seconds)
        for make in (stage.shading_call, stage.frame_call)
    )
    return {rule.name: {"ms": shading[rule.name], "frame_ms": frame[rule.name]} for rule in timed}
