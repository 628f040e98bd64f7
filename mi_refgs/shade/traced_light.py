"""What blocked mirror rays hit: the mesh, shaded by the split sum with the materials of the surfels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import FACING_TOLERANCE
from mi_refgs.occlusion.surface_materials import Surface, SurfaceSample
from mi_refgs.occlusion.visibility import Occluder
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.shade.split_sum import lookup_direction, shade
from mi_refgs.surfels.table import Surfels


@dataclass(frozen=True)
class MeshHit:
    """A hit of the mesh, and whether light arrives there along the mirror direction (0 or 1); detached."""

    valid: Any
    triangle: Any
    barycentric: Any
    visibility: Any
    next: MeshHit | None = None  # where it does not: what stands in its way, if that is shaded too


@dataclass(frozen=True)
class MeshRadiance:
    """The mesh as the second surface that light meets: shaded by `shade` with the materials of the surfels.

    Its specular light must arrive along its own mirror direction, which is traced once more: without that, a
    hit deep in a bowl shines as if it lay in the open, and the picture is worse than with no indirect light
    at all (relMSE 4.7 against 1.0, at roughness 0.3; with it 0.2 at 0.4). What blocks it is another hit,
    shaded likewise, `options.traced_bounces` times in all; what is blocked at the last is dark. (No closing
    term was better in every concave scene: with 64 rays, 2 bounces and roughness 0.1, relMSE in a bowl is
    0.10 with none, 0.98 with the unblocked light and 3.8 with the irradiance.) The recursion is unrolled:
    every number of bounces is a kernel of its own, and its length grows with them.

    With diffuse="sh" the diffuse part is the SH radiance of the surfel nearest to the hit, along the ray: the
    same quantity that pixels blend, and like it tied to the light it was fitted under; a picture to be relit
    asks for "irradiance" in either place.
    """

    occluder: Occluder
    surface: Surface
    light: Light
    options: ShadingOptions
    harmonics: Any  # mi.Float (3 C N): the radiance channel by rows; empty unless diffuse="sh"
    count: int  # C

    @staticmethod
    def of(occluder: Occluder, surfels: Surfels, light: Light, options: ShadingOptions) -> MeshRadiance:
        """Take the present values of all arguments, and evaluate them."""
        surfels = surfels.cleaned()  # one that became unusable after `set_materials` may still be looked up
        surface = occluder.surface(surfels)
        coefficients = surfels.radiance_sh() if options.diffuse == "sh" else []
        # In rows: the adjoint of a hit's gather is then a table of its own. Columns themselves, whose adjoint
        # writes packets, must not be written to in the same kernel.
        harmonics = dr.ravel(mi.ArrayXf([x for c in coefficients for x in c])) if coefficients else mi.Float()
        dr.eval(surface.rows, harmonics)
        return MeshRadiance(occluder, surface, light, options, harmonics, len(coefficients))

    def light_from(self, normal: Any, view: Any, roughness: Any) -> Any:
        """Radiance (mi.Color3f) of the light as `shade` looks it up at points of unit normals and views."""
        return self.light.specular(lookup_direction(normal, view, roughness, self.options), roughness)

    def trace(self, point: Any, direction: Any, normal: Any, active: Any, bounces: int) -> MeshHit:
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

    def radiance(self, hit: MeshHit, direction: Any) -> Any:
        """Radiance (mi.Color3f) that leaves the hits against the rays, under AD."""
        sample = self.surface.at(hit.triangle, hit.barycentric, hit.valid)
        normal = self._facing(sample, direction)
        own = None
        if self.count:
            row = sample.surfel * self.count
            coefficients = [
                dr.gather(mi.Color3f, self.harmonics, row + i, hit.valid) for i in range(self.count)
            ]
            own = clamp_positive(eval_sh(coefficients, direction) + 0.5)
        ambient = None
        if self.options.ambient_rays and self.occluder.ambient is not None:
            ambient = self.occluder.ambient.at(hit.triangle, hit.barycentric, hit.valid)
        indirect = None
        if hit.next is not None:
            indirect = self.radiance(hit.next, reflect(view=-direction, normal=normal))
        points = ShadingPoints(
            normal=normal,
            view=-direction,
            albedo=sample.albedo,
            metallic=sample.metallic,
            roughness=sample.roughness,
            radiance=own,
            visibility=hit.visibility,
            indirect=indirect,
            ambient=ambient,
        )
        return shade(points, self.light, self.options).total()

    def _facing(self, sample: SurfaceSample, direction: Any) -> Any:
        """Unit normal on the ray's side, but for one that only leans away (see `FACING_TOLERANCE`)."""
        normal = dr.detach(safe_normalize(sample.normal))
        return dr.select(dr.dot(normal, direction) > FACING_TOLERANCE, -normal, normal)
