"""The model of 3DGS-DR: a fitted radiance mixed with a perfect mirror. [Ye et al. 2024, §3.2]"""

from typing import Any

from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect, safe_normalize
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.surfels.table import Surfels


class Mirror(Reflectance):
    """c = (1 - m) radiance + m L(r), of the unfiltered light in the mirror direction r; m is `metallic`."""

    name = "mirror"
    light = "radiance"

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("radiance_sh", "metallic")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        radiance = seen.harmonic_colour(surfels.value("radiance_sh"))
        return {"radiance": radiance, "metallic": surfels.value("metallic")}

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        mirror = reflect(safe_normalize(points.view), safe_normalize(points.normal))
        share = points.metallic
        return RadianceTerms((1 - share) * points.radiance, share * light.radiance(mirror))
