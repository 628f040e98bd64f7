"""The model of Ref-Gaussian: diffuse radiance under a GGX layer, lit by a split sum. [Yao 2025, §3.2-3.3]"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mi_refgs.shade import split_sum
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, reflect
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Color3f, Float

MATERIALS = ("albedo", "metallic", "roughness")  # attributes of the surface under the light


class SplitSum(Reflectance):
    """The equations of `shade.split_sum`, with what mirror rays find (`shade.reflection`)."""

    name = "split_sum"
    visibility = "mirror"
    honoured = ("dominant", "antialias", "visibility_rays", "traced_bounces", "ambient_rays")

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return (*MATERIALS, "radiance_sh") if options.diffuse == "sh" else MATERIALS

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        values = {name: surfels.value(name) for name in MATERIALS}
        if options.diffuse == "sh":
            values["radiance"] = seen.harmonic_colour(surfels.value("radiance_sh"))
        if options.occlusion and surfels.has("indirect_sh") and not options.traced_bounces:
            # The mirror direction of the surfel's centre [Ref-Gaussian, §3.3]; starts at exactly 0 and must
            # train from there.
            mirrored = reflect(view=-seen.direction, normal=seen.normal)
            values["indirect"] = clamp_positive(eval_sh(surfels.value("indirect_sh"), mirrored))
        return values

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        return split_sum.shade(points, light, options)

    def lobe(self, points: ShadingPoints) -> tuple[Float, Color3f]:
        return points.roughness, split_sum.base_reflectance(points)

    def textures(self, values: Mapping[str, Any]) -> dict[str, Any]:
        return {name: values[name] for name in MATERIALS}
