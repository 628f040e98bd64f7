"""The model of Ref-Gaussian: diffuse radiance under a GGX layer, lit by a split sum.

Points have albedo (mi.Color3f, 0 … 1: diffuse reflectance, or F0 of a metal), metallic (mi.Float, 0 … 1) and
roughness (mi.Float, 0 … 1, α = roughness²); for diffuse="sh" also radiance (mi.Color3f), as fitted.

[Reflective Gaussian Splatting, §3.2-3.3; split sum: Karis 2013]"""

from collections.abc import Mapping
from typing import Any

import drjit as dr

from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Color3f, Float, Vector3f

MATERIALS = ("albedo", "metallic", "roughness")  # attributes of the surface under the light
DIELECTRIC_F0 = 0.04  # reflectance at normal incidence of a dielectric (index of refraction 1.5)
SMOOTHNESS_FLOOR = 1e-12  # least 1 - α in √(1 - α), whose slope is infinite at α = 1


def base_reflectance(points: ShadingPoints) -> Color3f:
    """F0: reflectance at normal incidence, between a dielectric's and the metal's albedo."""
    return dr.fma(points.albedo - DIELECTRIC_F0, points.metallic, DIELECTRIC_F0)


def lookup_direction(normal: Vector3f, view: Vector3f, roughness: Float, options: ShadingOptions) -> Vector3f:
    """Unit direction in which the light is looked up: mirrored, or dominant, near the peak of the GGX lobe, s
    (√s + α) of the way from the normal, α = roughness², s = 1 - α. Unit vectors in. [Lagarde and de Rousiers
    2014, "Moving Frostbite to Physically Based Rendering", §4.9.3]"""
    mirror = reflect(view, normal)
    if not options.dominant:
        return mirror
    α = dr.square(dr.clip(roughness, 0, 1))
    smooth = 1 - α
    mirrored = smooth * (dr.sqrt(dr.maximum(smooth, SMOOTHNESS_FLOOR)) + α)
    return safe_normalize(dr.lerp(normal, mirror, mirrored))


class SplitSum(Reflectance):
    """The split sum, with what mirror rays find (`shade.reflection`)."""

    name = "split_sum"
    visibility = "mirror"
    honoured = ("dominant", "antialias", "visibility_rays", "traced_bounces", "ambient_rays")

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return (*MATERIALS, "radiance_sh") if options.diffuse == "sh" else MATERIALS

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        values = {name: surfels.value(name) for name in MATERIALS}
        if options.diffuse == "sh":
            values["radiance"] = seen.harmonic_colour(surfels.value("radiance_sh"))
        name = "residual_sh" if options.traced_bounces else "indirect_sh"
        if options.occlusion and surfels.has(name):
            # The mirror direction of the surfel's centre [Ref-Gaussian, §3.3]; starts at exactly 0 and must
            # train from there.
            found = eval_sh(surfels.value(name), reflect(view=-seen.direction, normal=seen.normal))
            values |= {"residual": found} if options.traced_bounces else {"indirect": clamp_positive(found)}
        return values

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        """Outgoing radiance towards the camera, as separate terms.

        With F0 = 0.04 (1 - metallic) + albedo metallic, S = F0 A(n·v, roughness) + B and the reflected
        direction r (`lookup_direction`): specular = V L(r, roughness) S, indirect = (1 - V) L_indirect S, of
        `indirect` + `residual`, diffuse = (1 - metallic) radiance ("sh") or (1 - S) (1 - metallic) albedo
        irradiance(n) ambient ("irradiance"; see `shade.ambient`). A point seen from behind keeps its mirror
        direction, at grazing incidence. Under a constant light of 1 no more than 1 leaves with "irradiance".

        Finite for every finite input. Raises InputError for "sh" without a radiance."""
        # Directional reflectance, and the light in the specular lobe.
        normal, view = safe_normalize(points.normal), safe_normalize(points.view)
        scale, bias = split_sum(dr.dot(normal, view), points.roughness)
        reflectance = dr.fma(base_reflectance(points), scale, bias)
        direction = lookup_direction(normal, view, points.roughness, options)
        specular = light.specular(direction, points.roughness) * reflectance

        # Visibility of that light, and what blocks it.
        indirect = None
        visibility, met = points.get("visibility"), points.get("indirect")
        if visibility is not None:
            specular *= visibility
            if met is not None:
                indirect = (1 - visibility) * clamp_positive(met + points.get("residual", 0)) * reflectance

        # Diffuse base under the specular layer.
        if options.diffuse == "irradiance":
            # The table, extrapolated, exceeds 1 by up to 1e-4: no negative light from that.
            transmitted = dr.maximum(1 - reflectance, 0)
            incident = light.irradiance(normal)
            if (ambient := points.get("ambient")) is not None:
                incident *= ambient
            diffuse = transmitted * (1 - points.metallic) * points.albedo * incident
        else:
            diffuse = (1 - points.metallic) * points.radiance
        return RadianceTerms(diffuse, specular, indirect)

    def lobe(self, points: ShadingPoints) -> tuple[Float, Color3f]:
        return points.roughness, base_reflectance(points)

    def textures(self, values: Mapping[str, Any]) -> dict[str, Any] | None:
        return {name: values[name] for name in MATERIALS}
