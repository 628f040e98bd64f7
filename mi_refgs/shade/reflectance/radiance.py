"""The fitted radiance alone: a view-dependent SH colour and no light. [3DGS, §4; 2DGS]"""

from __future__ import annotations

from typing import Any

from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.surfels.table import Surfels


class Radiance(Reflectance):
    """c = max(0, ½ + Σ c Y(d)), as it is."""

    name = "radiance"
    order_independent = True
    light = "none"

    def channels(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("radiance_sh",)

    def attributes(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return {"radiance": seen.harmonic_colour(surfels.value("radiance_sh"))}

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        return RadianceTerms(points.radiance)
