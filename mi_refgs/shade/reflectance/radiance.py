"""Fitted radiance without a light: a view-dependent SH colour, linear or display-encoded. [3DGS, §4; 2DGS]"""

from typing import Any

import drjit as dr

from mi_refgs.io.images import SRGB_ENCODED_LIMIT
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

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("radiance_sh",)

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        return {"radiance": seen.harmonic_colour(surfels.value("radiance_sh"))}

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        return RadianceTerms(points.radiance)


class Displayed(Radiance):
    """c = linear(e), with e the mean of max(0, ½ + Σ c Y(d)) over what a pixel sees, since 3DGS and 2DGS
    blend encoded colours, A e = Σ w e_i, and show A e + (1 - A) background. [3DGS, §4; 2DGS]"""

    name = "displayed"
    shaded_at = ("pixel",)
    order_independent = False
    encoded = True

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        encoded = points.radiance
        straight = encoded <= SRGB_ENCODED_LIMIT
        curve = dr.power((dr.select(straight, 1, encoded) + 0.055) / 1.055, 2.4)
        return RadianceTerms(dr.select(straight, encoded / 12.92, curve))
