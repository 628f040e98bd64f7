"""The model of GaussianShader: a colour, a diffuse and a tinted specular layer. [Jiang et al. 2024, §4]"""

from typing import Any

import drjit as dr

from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.surfels.table import Surfels


class GaussianShader(Reflectance):
    """c = radiance + (1 - tint) E(n) + (tint A + B) L(r, roughness), with E the irradiance of the normal, to
    which a fitted `normal_offset` is added (theirs: one a side, and a light in [0, 1])."""

    name = "gaussian_shader"
    shaded_at = ("surfel",)

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("radiance_sh", "roughness", "tint", "normal_offset")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        turned = dr.detach(dr.dot(surfels.primitive.normal(surfels), seen.normal)) < 0
        x, y, z = surfels.value("normal_offset")
        offset = type(seen.normal)(x, y, z)
        return {
            "normal": safe_normalize(seen.normal + dr.select(turned, -offset, offset)),
            "radiance": seen.harmonic_colour(surfels.value("radiance_sh")),
            "roughness": surfels.value("roughness"),
            "tint": surfels.value("tint"),
        }

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        normal, view = safe_normalize(points.normal), safe_normalize(points.view)
        scale, bias = split_sum(dr.dot(normal, view), points.roughness)
        diffuse = points.radiance + (1 - points.tint) * light.irradiance(normal)
        reflected = light.specular(reflect(view, normal), points.roughness)
        return RadianceTerms(diffuse, dr.fma(points.tint, scale, bias) * reflected)
