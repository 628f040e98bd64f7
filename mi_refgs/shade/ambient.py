"""How much of a diffuse surface's light the object itself takes away, and what it sends back instead.

`light.irradiance` is that of a surface that sees all of its hemisphere. `options.ambient_rays` rays from
every vertex of the occluding mesh, cosine-weighted, say what it sees instead:

    ratio = Σ (free ? L(ω) : B(ω)) / Σ L(ω)

in each colour, L being the light and B the radiance that leaves what stands in the way. So a ratio has the
shadows of the present light, not only how open a place is, and the diffuse term is albedo × irradiance of
the pixel's normal × ratio. Where nothing is in the way it is 1, whatever the rays.

L is looked up in the lobe that is as wide as the part of the hemisphere a ray stands for, so that no lamp
falls between them. B is shaded by the split sum as traced light is (`shade.reflection`), with the ratios
of the round before at what is hit, 1 in the first: each of BOUNCES rounds adds a bounce. Ratios are detached,
and stay until they are found again.
"""

from __future__ import annotations

from dataclasses import replace
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
from mi_refgs.shade.reflection import MeshRadiance
from mi_refgs.surfels.table import Surfels

BOUNCES = 2
"""Times that light bounces from what stands in the way before it is taken as unblocked."""

BRIGHTEST = 4.0
"""Largest ratio: a mirror that sends a lamp to one of a few rays makes a vertex shine otherwise."""


def update_occluder_caches(
    occluder: Occluder, surfels: Surfels, light: Light | None, options: ShadingOptions
) -> None:
    """Give a mesh what `options` asks for: materials if its hits are shaded, and ambient ratios.

    To be called again when mesh, surfels or light have changed; nothing is done where nothing is asked for.
    Raises InputError as `Occluder.set_materials` does.
    """
    if occluder.empty:
        return
    if options.traced_bounces or options.ambient_rays:
        occluder.set_materials(surfels)
    if options.ambient_rays and light is not None:
        with dr.suspend_grad():
            occluder.ambient = ambient(occluder, surfels, light, options)


def ambient(occluder: Occluder, surfels: Surfels, light: Light, options: ShadingOptions) -> VertexColours:
    """The ratios of all vertices of a mesh whose materials are set; see the head of this file. Detached."""
    mesh = occluder.mesh()
    assert mesh is not None
    place = mi.Point3f(mesh.vertices.T)
    normal = safe_normalize(occluder.surface(surfels).vertex_surfels.normal)
    occluder.ambient = None  # all light arrives, in the first round
    for _ in range(BOUNCES):
        scene = MeshRadiance.of(
            occluder, surfels, light, replace(options, traced_bounces=1, diffuse="irradiance")
        )
        ratio = _round(scene, place, normal, options.ambient_rays)
        occluder.ambient = found = VertexColours.of(mesh, ratio.numpy().T)
    return found


def ray_roughness(count: int) -> float:
    """Roughness of the lobe around a mirrored ray whose solid angle at its middle, 4 π α², is π / count."""
    return float((4 * count) ** -0.25)


def ambient_direction(frame: Any, turn: Any, ray: Any, count: Any) -> Any:
    """Unit direction `ray` of `count` around the z axis of frames, with density cosθ / π."""
    along, around = lobe_point(turn, ray, count)
    sin, cos = dr.sincos(dr.two_pi * around)
    across = dr.sqrt(along)
    return frame.to_world(mi.Vector3f(across * cos, across * sin, dr.sqrt(1 - along)))


def _round(scene: MeshRadiance, place: Any, normal: Any, rays: int) -> Any:
    """Ratios (mi.Color3f) at vertices, with the present ones at what stands in the way."""
    frame, turn = mi.Frame3f(normal), lobe_turn(dr.arange(mi.UInt32, dr.width(normal)))
    count, blur = dr.opaque(mi.UInt32, rays), dr.opaque(mi.Float, ray_roughness(rays))

    def body(index: Any, arrives: Any, every: Any) -> tuple[Any, ...]:
        direction = ambient_direction(frame, turn, index, count)
        radiance = scene.light.specular(direction, blur)
        hit = scene.trace(place, direction, normal, True, 1)
        arrives = arrives + dr.select(hit.valid, scene.radiance(hit, direction), radiance)
        return index + 1, arrives, every + radiance

    start = (dr.zeros(mi.UInt32, dr.width(normal)), mi.Color3f(0), mi.Color3f(0))
    _, arrives, every = dr.while_loop(start, lambda index, *_: index < count, body, label="ambient")
    ratio = dr.select(every > 0, arrives * dr.rcp(dr.select(every > 0, every, 1)), 1)
    return dr.clip(ratio, 0, BRIGHTEST)


def ambient_of_pixels(occluder: Occluder, origin: Any, ray: Any, covered: Any) -> Any:
    """Ratio (mi.Color3f, detached) where the pixels' rays meet the mesh, and 1 where they miss it.

    Raises InputError if the mesh has no ratios.
    """
    if occluder.empty:
        return mi.Color3f(1)
    if occluder.ambient is None:
        raise InputError(
            "occluder: ambient: none for this mesh; call shade.ambient.update_occluder_caches after update"
        )
    with dr.suspend_grad():
        hit = occluder.closest(origin, ray, None, covered)
        ratio = dr.select(hit.valid, occluder.ambient.at(hit.triangle, hit.barycentric, hit.valid), 1)
        # Now, once: every kernel of the adjoint that reads it would trace the rays again.
        dr.eval(ratio)
        return ratio
