"""Traced mirror rays: visibility of the light, and radiance of the mesh where it blocks it."""

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import FACING_TOLERANCE
from mi_refgs.occlusion.surface_materials import SurfaceSample, VertexColours
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.ggx_sampling import Lobe
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance.model import MODELS, SurfelView, TraceContext
from mi_refgs.shade.reflectance.split_sum import lookup_direction
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Bool, Color3f, Float, Point2f, Point3f, UInt32, Vector3f

CLAMP_MAX_ALPHA = 1 / 3  # α from which single bright rays are not clamped: at 0.36 it adds 15 % of relMSE


@dataclass(frozen=True)
class MeshHit:
    """Hits of N rays, and whether light is visible there in the mirror direction; detached."""

    valid: Bool
    triangle: UInt32
    barycentric: Point2f
    visibility: Float  # 0 or 1
    next: "MeshHit | None" = None  # what blocks it, if that is shaded too


class MeshRadiance:
    """Radiance of the mesh, shaded with the attributes of surfels, harmonics of the nearest. What blocks a
    hit's mirror direction is another hit, `traced_bounces` times; what is blocked at last is dark."""

    def __init__(
        self,
        occluder: Occluder,
        surfels: Surfels,
        light: Light,
        options: ShadingOptions,
        ambient: VertexColours | None,  # ratios of irradiance that arrive, see `shade.ambient`
    ) -> None:
        """Take the present values of all arguments, and evaluate them."""
        self.occluder, self.light, self.options, self.ambient = occluder, light, options, ambient
        surfels = surfels.cleaned()  # one that became unusable after `set_materials` may still be looked up
        names = MODELS[options.reflectance].required_attributes(options)
        self.surface = occluder.surface(surfels, [name for name in names if not attribute(name).harmonics])
        self.harmonics: dict[str, tuple[Float, int]] = {}  # coefficients (3 C N,) by rows, and C
        for name in (name for name in names if attribute(name).harmonics):
            # In rows, whose adjoint is a table of its own: the columns must not be written to in that kernel.
            coefficients = surfels.value(name)
            rows = dr.ravel(mi.ArrayXf([x for c in coefficients for x in c]))
            self.harmonics[name] = rows, len(coefficients)
        dr.eval(self.surface.rows, self.harmonics)

    def trace(
        self, point: Point3f, direction: Vector3f, normal: Vector3f, active: Bool, bounces: int
    ) -> MeshHit:
        """What rays of `Occluder.visible` hit first, and what their mirror rays hit, `bounces` ≥ 1 times."""
        with dr.suspend_grad():
            hit = self.occluder.closest(point, direction, normal, active)
            outward = self._facing(self.surface.at(hit.triangle, hit.barycentric, hit.valid), direction)
            mirror = reflect(view=-direction, normal=outward)
            if bounces == 1:
                free = self.occluder.visible(hit.point, mirror, outward, hit.valid)
                return MeshHit(hit.valid, hit.triangle, hit.barycentric, free)
            further = self.trace(hit.point, mirror, outward, hit.valid, bounces - 1)
            free = dr.select(further.valid, mi.Float(0), mi.Float(1))
            return MeshHit(hit.valid, hit.triangle, hit.barycentric, free, further)

    def radiance(self, hit: MeshHit, direction: Vector3f, origin: Point3f | None = None) -> Color3f:
        """Radiance that leaves the hits against the rays, under AD. Given an `origin`, hits move with rays;
        later hits stay: errors of normals are magnified there beyond what a derivative says."""
        where = hit.barycentric
        if origin is not None and dr.grad_enabled(direction):
            where = self.surface.followed(hit.triangle, where, origin, direction, hit.valid)
        sample = self.surface.at(hit.triangle, where, hit.valid)
        normal = self._facing(sample, direction)
        ambient = indirect = None
        attributes = dict(sample.values)
        for name, (rows, count) in self.harmonics.items():
            row = sample.surfel * count
            attributes[name] = [dr.gather(mi.Color3f, rows, row + i, hit.valid) for i in range(count)]
        surfels: Any = SimpleNamespace(has=attributes.__contains__, value=attributes.__getitem__)
        model = MODELS[self.options.reflectance]
        values = {**model.values(surfels, SurfelView(direction, normal), self.options)}
        if self.options.ambient_rays and self.ambient is not None:
            ambient = self.ambient.at(hit.triangle, hit.barycentric, hit.valid)
        if hit.next is not None:
            indirect = self.radiance(hit.next, dr.detach(reflect(view=-direction, normal=normal)))
        traced = {"visibility": hit.visibility, "indirect": indirect, "ambient": ambient}
        points = ShadingPoints(values.pop("normal", normal), -direction, values | traced)
        return model.shade(points, self.light, self.options).total()

    def _facing(self, sample: SurfaceSample, direction: Vector3f) -> Vector3f:
        """Unit normal on the ray's side, unless it only leans away (see `FACING_TOLERANCE`)."""
        normal = safe_normalize(sample.normal)
        return dr.select(dr.detach(dr.dot(normal, direction)) > FACING_TOLERANCE, -normal, normal)


def reflection(points: ShadingPoints, context: TraceContext, options: ShadingOptions) -> ShadingPoints:
    """The points with visibility (mi.Float, 0 … 1, detached) and indirect light, as `options` require: of
    what blocked rays hit with `traced_bounces`, with gradients of the light, of materials and normals around
    hits, and for one ray of the points' normals."""
    occluder, scene, bounces = context.occluder, None, options.traced_bounces
    sampled = options.visibility_rays > 1
    if occluder.empty and (sampled or bounces):
        return points.replaced(visibility=dr.full(mi.Float, 1, dr.width(context.ray)), indirect=None)
    if bounces:
        assert context.light is not None  # by `Shading.require_inputs`
        scene = MeshRadiance(occluder, context.surfels, context.light, options, occluder.ambient)
    with dr.suspend_grad():
        start = point, facing, seen = context.start(dr.detach(points.normal))
    ray = point, reflect(view=dr.detach(points.view), normal=safe_normalize(points.normal)), facing
    if sampled:
        visibility, indirect = _average(points, context, scene, start, options)
    else:
        visibility = occluder.visible(*ray, seen)
        dr.eval(visibility)  # now, once: every kernel of the adjoint that reads it would trace the rays again
        indirect = points.get("indirect") if scene is None else _met(scene, ray, visibility, bounces)
    return points.replaced(visibility=visibility, indirect=indirect)


def _met(scene: MeshRadiance, ray: tuple[Point3f, Vector3f, Vector3f], free: Float, bounces: int) -> Color3f:
    """Radiance of what rays (N,) meet, 0 where `free`. Those that are blocked are few, and shaded alone."""
    found, blocked = dr.zeros(mi.Color3f, dr.width(free)), dr.compress(free == 0)
    if dr.width(blocked):
        dr.eval(ray)  # in one kernel, not in each gather's
        once = dr.ReduceMode.NoConflicts
        point, direction, normal = (dr.gather(type(x), x, blocked, mode=once) for x in ray)
        hit = scene.trace(point, direction, normal, True, bounces)
        dr.eval(hit)
        dr.scatter(found, dr.select(hit.valid, scene.radiance(hit, direction, point), 0), blocked)
    return found


def _average(
    points: ShadingPoints,
    context: TraceContext,
    scene: MeshRadiance | None,
    start: tuple[Point3f, Vector3f, Bool],
    options: ShadingOptions,
) -> tuple[Float, Color3f | None]:
    """Mean visibility over samples of the lobe, and of a `scene` mean radiance of the blocked ones."""
    point, facing, seen = start
    count = dr.opaque(mi.UInt32, options.visibility_rays)
    with dr.suspend_grad():
        roughness, f0 = MODELS[options.reflectance].lobe(points)
        lobe = Lobe.of(facing, points.view, roughness, f0, context.pixel)
        unblocked = None  # mean radiance of the others
        if scene is not None:
            towards = lookup_direction(facing, points.view, roughness, options)
            unblocked = scene.light.specular(towards, roughness)

    def body(index: Any, free: Any, blocked: Any, total: Any, largest: Any) -> tuple[Any, ...]:
        with dr.suspend_grad():
            direction, weight = lobe.sample(index, count)
            if scene is None:
                stopped = context.occluder.visible(point, direction, facing, weight > 0) == 0
            else:
                hit = scene.trace(point, direction, facing, weight > 0, options.traced_bounces)
                stopped = hit.valid
        if scene is not None:
            found = dr.select(stopped, weight * scene.radiance(hit, direction), 0)
            total = total + found
            largest = dr.maximum(largest, dr.detach(found))
        free, blocked = free + dr.select(stopped, 0, weight), blocked + dr.select(stopped, weight, 0)
        return index + 1, free, blocked, total, largest

    # A sum over rays, whose derivative keeps no state of an iteration: max_iterations = -1.
    state = (mi.UInt32(0), mi.Float(0), mi.Float(0), mi.Color3f(0), mi.Color3f(0))
    _, free, blocked, total, largest = dr.while_loop(
        state, lambda index, *_: seen & (index < count), body, max_iterations=-1, label="lobe"
    )
    every = free + blocked
    visibility = dr.select(every > 0, free / dr.select(every > 0, every, 1), 1)
    if scene is None:
        dr.eval(visibility)
        return dr.detach(visibility), points.get("indirect")
    total = total * _firefly_clamp(dr.detach(total), largest, free * unblocked, mi.Float(count), lobe.α)
    indirect = total * dr.select(blocked > 0, dr.rcp(dr.select(blocked > 0, blocked, 1)), 0)
    dr.eval(visibility, indirect)
    return dr.detach(visibility), indirect


def _firefly_clamp(total: Color3f, largest: Color3f, free: Color3f, count: Float, α: Float) -> Color3f:
    """Factor (0 … 1, detached) of the sum over blocked rays, per colour: the `largest` of `count` counts for
    no more than all would at the mean of the others, `free` included. It fades with α, and with more rays."""
    others = dr.maximum(total - largest, 0)
    narrow = dr.maximum(1 - α / CLAMP_MAX_ALPHA, 0)
    excess = dr.maximum(largest - (others + free) * count / (count - 1), 0) * narrow
    return dr.select(total > 0, dr.maximum(1 - excess / dr.select(total > 0, total, 1), 0), 1)
