"""The fitted radiance alone: a view-dependent SH colour and no light. [3DGS, §4; 2DGS]"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mi_refgs.shade.points import RadianceTerms, ShadingPoints
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.shade.shading import Shading


class Radiance(Reflectance):
    """c = max(0, ½ + Σ c Y(d)), as it is."""

    name = "radiance"
    order_independent = True
    light = "none"

    def channels(self, diffuse: str) -> tuple[str, ...]:
        return ("radiance_sh",)

    def attributes(self, surfels: Surfels, seen: SurfelView, shading: Shading) -> dict[str, Any]:
        return {"radiance": seen.harmonic_colour(surfels.value("radiance_sh"))}

    def shade(self, points: ShadingPoints, light: Any, shading: Shading) -> RadianceTerms:
        return RadianceTerms(points.radiance)
