"""The model of Ref-Gaussian: diffuse radiance under a GGX layer, lit by a split sum. [Yao 2025, §3.2-3.3]"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mi_refgs.shade import split_sum
from mi_refgs.shade.ambient import ambient_of_pixels
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView, TraceContext
from mi_refgs.shade.reflection import reflection
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.shade.shading import Shading


MATERIALS = ("albedo", "metallic", "roughness")
"""Channels of the surface under the light."""


class SplitSum(Reflectance):
    """The equations of `shade.split_sum`, with what mirror rays find (`shade.reflection`)."""

    name = "split_sum"
    visibility = "mirror"
    accuracy = (
        "dominant",
        "multiscatter",
        "antialias",
        "visibility_rays",
        "traced_bounces",
        "ambient_rays",
    )

    def channels(self, diffuse: str) -> tuple[str, ...]:
        return (*MATERIALS, "radiance_sh") if diffuse == "sh" else MATERIALS

    def attributes(self, surfels: Surfels, seen: SurfelView, shading: Shading) -> dict[str, Any]:
        values = {name: surfels.value(name) for name in MATERIALS}
        if shading.diffuse == "sh":
            values["radiance"] = seen.harmonic_colour(surfels.value("radiance_sh"))
        if shading.occlusion and surfels.has("indirect_sh") and not shading.accuracy.traced_bounces:
            # The mirror direction of the surfel's centre [Ref-Gaussian, §3.3]; starts at exactly 0 and must
            # train from there.
            mirrored = reflect(view=-seen.direction, normal=seen.normal)
            values["indirect"] = clamp_positive(eval_sh(surfels.value("indirect_sh"), mirrored))
        return values

    def shade(self, points: ShadingPoints, light: Any, shading: Shading) -> RadianceTerms:
        return split_sum.shade(points, light, shading.diffuse, shading.accuracy)

    def trace(self, points: ShadingPoints, context: TraceContext, shading: Shading) -> ShadingPoints:
        points = reflection(points, context, shading.diffuse, shading.accuracy)
        if not shading.accuracy.ambient_rays:
            return points
        ratio = ambient_of_pixels(context.occluder, context.origin, context.ray, context.covered)
        return points.replaced(ambient=ratio)
