"""Ambient visibility: how much of the diffuse light the object itself blocks, and what it reflects instead.

`light.irradiance` assumes that the whole hemisphere is visible. `options.ambient_rays` cosine-weighted rays
per vertex of the occluding mesh give the ratio to it per colour,

    ratio = Σ (free ? L(ω) : B(ω)) / Σ L(ω),

L being the light, in a lobe as wide as the part of the hemisphere per ray, and B the radiance of the mesh
where it blocks the ray, shaded with the ratios of the previous round, 1 in the first. The diffuse term is
albedo × irradiance × ratio; ratios are detached."""

from dataclasses import asdict
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.occlusion.surface_materials import VertexColours
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.ggx_sampling import lobe_point, lobe_turn
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import safe_normalize
from mi_refgs.shade.reflectance.model import TraceContext
from mi_refgs.shade.reflection import MeshRadiance
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Color3f, UInt32, Vector3f

BOUNCES = 2  # rounds: bounces of light between surfaces before it is taken as unblocked
BRIGHTEST = 4.0  # largest ratio: a mirror that reflects a lamp into one of a few rays makes a vertex shine


def update_occluder_caches(
    occluder: Occluder, surfels: Surfels, light: Light | None, options: ShadingOptions
) -> None:
    """Set `occluder.vertex_surfels` if hits are shaded, `occluder.ambient` if there are `ambient_rays`, after
    each change of mesh, surfels or light. Raises InputError as `Occluder.set_materials`."""
    if occluder.empty:
        return
    if options.traced_bounces or options.ambient_rays:
        occluder.set_materials(surfels)
    if options.ambient_rays and light is not None:
        with dr.suspend_grad():
            occluder.ambient = ambient(occluder, surfels, light, options)


def ambient(occluder: Occluder, surfels: Surfels, light: Light, options: ShadingOptions) -> VertexColours:
    """Ratios of all vertices of a mesh whose materials are set, detached; see the head of this file."""
    mesh = occluder.mesh
    assert mesh is not None
    position = mi.Point3f(mesh.vertices.T)
    normal = safe_normalize(occluder.surface(surfels).vertex_surfels.normals(surfels))
    frame, turn = mi.Frame3f(normal), lobe_turn(dr.arange(mi.UInt32, dr.width(normal)))
    rays = dr.opaque(mi.UInt32, options.ambient_rays)
    blur = dr.opaque(mi.Float, (4 * options.ambient_rays) ** -0.25)  # 4 π α², its solid angle, is π / rays
    traced = ShadingOptions(**asdict(options) | {"traced_bounces": 1, "diffuse": "irradiance"})
    ratios: VertexColours | None = None  # the first round is unoccluded
    for _bounce in range(BOUNCES):
        scene = MeshRadiance(occluder, surfels, light, traced, ratios)

        def body(index: Any, arrives: Any, total: Any, scene: MeshRadiance = scene) -> tuple[Any, ...]:
            direction = ambient_direction(frame, turn, index, rays)
            radiance = scene.light.specular(direction, blur)
            hit = scene.trace(position, direction, normal, True, 1)
            arrives = arrives + dr.select(hit.valid, scene.radiance(hit, direction), radiance)
            return index + 1, arrives, total + radiance

        start = (dr.zeros(mi.UInt32, dr.width(normal)), mi.Color3f(0), mi.Color3f(0))
        _, arrives, total = dr.while_loop(start, lambda index, *_: index < rays, body, label="ambient")
        ratio = dr.select(total > 0, arrives * dr.rcp(dr.select(total > 0, total, 1)), 1)
        ratios = VertexColours(mesh, dr.clip(ratio, 0, BRIGHTEST).numpy().T)
    assert ratios is not None
    return ratios


def ambient_direction(frame: Any, turn: UInt32, ray: UInt32, count: UInt32) -> Vector3f:
    """Unit direction `ray` of `count` around the z axis of frames, with density cosθ / π."""
    along, around = lobe_point(turn, ray, count)
    sin, cos = dr.sincos(dr.two_pi * around)
    across = dr.sqrt(along)
    return frame.to_world(mi.Vector3f(across * cos, across * sin, dr.sqrt(1 - along)))


def ambient_of_pixels(context: TraceContext) -> Color3f:
    """Ratio where pixels' rays meet the mesh, else 1; detached. Raises InputError if the mesh has none."""
    occluder = context.occluder
    if occluder.empty:
        return mi.Color3f(1)
    if occluder.ambient is None:
        raise InputError("none for this mesh", "occluder", "ambient", "call update_occluder_caches")
    with dr.suspend_grad():
        hit = occluder.closest(context.origin, context.ray, None, context.covered)
        ratio = dr.select(hit.valid, occluder.ambient.at(hit.triangle, hit.barycentric, hit.valid), 1)
        # Now, once: every kernel of the adjoint that reads it would trace the rays again.
        dr.eval(ratio)
        return ratio
