"""The model of R3DG: incident light summed over directions of the hemisphere. [Gao et al. 2024, §3.3-3.4]"""

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import GOLDEN_ANGLE
from mi_refgs.shade.light.light import Light
from mi_refgs.shade.light.near_field import LocalLight
from mi_refgs.shade.options import ShadingOptions
from mi_refgs.shade.points import RadianceTerms, ShadingPoints, safe_normalize
from mi_refgs.shade.reflectance.model import Reflectance, SurfelView, TraceContext
from mi_refgs.shade.reflectance.split_sum import DIELECTRIC_F0
from mi_refgs.shade.sh import clamp_positive, eval_sh
from mi_refgs.surfels.table import Surfels

# As in R3DG's code: directions lie at least 10° above the horizon; (least, what the attribute adds at most).
LEAST_COSINE = math.sin(math.radians(10))
BASE_RANGE, ROUGHNESS_RANGE = (0.03, 0.77), (0.09, 0.9)


class MonteCarlo(Reflectance):
    """c = mean over J directions w of (b / π + f_s(w, v)) (V L(w) + max(0, SH(w; indirect))) 2π n·w.

    f_s is GGX with α = roughness², Smith-Schlick shadowing of k = (roughness + 1)² / 8, and F0 = 0.04.
    b = 0.03 + 0.77 albedo, roughness = 0.09 + 0.9 of the attribute. The directions are those of a Fibonacci
    hemisphere about the normal, J = `options.directions`; normal and position are detached. V is 0 where
    the mesh blocks the ray, if `options.occlusion`. The light of other surfaces, `indirect_sh`,
    counts where the surfels have it."""

    name = "monte_carlo"
    shaded_at = ("surfel",)
    light = "radiance"
    visibility = "own"
    honoured = ("directions",)

    def required_attributes(self, options: ShadingOptions) -> tuple[str, ...]:
        return ("albedo", "roughness")

    def values(self, surfels: Surfels, seen: SurfelView, options: ShadingOptions) -> dict[str, Any]:
        values = {name: surfels.value(name) for name in ("albedo", "roughness")}
        if surfels.has("indirect_sh"):
            values["incident"] = surfels.value("indirect_sh")
        return values

    def textures(self, values: Mapping[str, Any]) -> dict[str, Any]:
        base = BASE_RANGE[1] * values["albedo"] + BASE_RANGE[0]
        roughness = ROUGHNESS_RANGE[1] * values["roughness"] + ROUGHNESS_RANGE[0]
        return {"albedo": base, "metallic": 0 * roughness, "roughness": roughness}

    def trace(self, points: ShadingPoints, context: TraceContext, options: ShadingOptions) -> ShadingPoints:
        """The points with `free` (mi.UInt64), bit j of which says that light arrives from direction j."""
        count = dr.opaque(mi.UInt32, options.directions)
        normal, position = dr.detach(safe_normalize(points.normal)), dr.detach(points.position)

        def body(index: Any, free: Any) -> tuple[Any, Any]:
            seen = context.occluder.visible(position, _direction(index, count, normal)[0], normal)
            bit = dr.select(seen > 0, mi.UInt64(1), mi.UInt64(0)) << mi.UInt64(index)
            return index + 1, free | bit

        with dr.suspend_grad():
            start = (mi.UInt32(0), dr.zeros(mi.UInt64, dr.width(position)))
            _, free = dr.while_loop(start, lambda index, _: index < count, body, label="visibility")
            dr.eval(free)  # now, once: every kernel of the adjoint that reads it would trace the rays again
        return points.replaced(free=free, visibility=mi.Float(dr.popcnt(free)) / mi.Float(count))

    def shade(self, points: ShadingPoints, light: Light, options: ShadingOptions) -> RadianceTerms:
        count = dr.opaque(mi.UInt32, options.directions)
        normal = dr.detach(safe_normalize(points.normal))
        if isinstance(light, LocalLight):  # as the normal: the loop's adjoint has its state's derivatives
            light = replace(light, position=dr.detach(light.position))
        free, incident = points.get("free"), points.get("incident")
        base = dr.fma(points.albedo, BASE_RANGE[1], BASE_RANGE[0])
        roughness = dr.fma(points.roughness, ROUGHNESS_RANGE[1], ROUGHNESS_RANGE[0])

        def body(index: Any, sums: Any, base: Any, roughness: Any, view: Any, incident: Any) -> Any:
            direction, cosine = _direction(index, count, normal)
            weight = 2 * dr.pi * cosine / mi.Float(count)
            scattered, glossy = base * (weight / dr.pi), weight * _ggx(normal, view, direction, roughness)
            arriving = light.radiance(direction)
            if free is not None:
                arriving = dr.select((free >> mi.UInt64(index)) & 1 > 0, arriving, 0)
            found = [scattered * arriving, glossy * arriving]
            if incident is not None:
                found.append((scattered + glossy) * clamp_positive(eval_sh(incident, direction)))
            sums = [total + part for total, part in zip(sums, found, strict=True)]
            return index + 1, sums, base, roughness, view, incident

        sums = [mi.Color3f(0) for _ in range(2 if incident is None else 3)]
        # A sum over directions, whose derivative keeps no state of an iteration: max_iterations = -1.
        start = (mi.UInt32(0), sums, base, roughness, safe_normalize(points.view), incident)
        loop = partial(dr.while_loop, max_iterations=-1, label="hemisphere")
        return RadianceTerms(*loop(start, lambda index, *_: index < count, body)[1])


def _direction(index: Any, count: Any, normal: Any) -> tuple[Any, Any]:
    """Direction of the Fibonacci hemisphere about unit normals (mi.Vector3f), and its cosine."""
    cosine = dr.maximum(1 - (mi.Float(index) + 0.5) / mi.Float(count), LEAST_COSINE)
    sin, cos = dr.sincos(GOLDEN_ANGLE * mi.Float(index))
    across = dr.sqrt(1 - dr.square(cosine))
    return mi.Frame3f(normal).to_world(mi.Vector3f(across * cos, across * sin, cosine)), cosine


def _ggx(normal: Any, view: Any, direction: Any, roughness: Any) -> Any:
    """f_s (mi.Float) of unit vectors; 0 for views from behind. Fresnel as a spherical Gaussian."""
    half = safe_normalize(view + direction)
    n_v, n_l = dr.maximum(dr.dot(normal, view), 0), dr.dot(normal, direction)
    n_h, v_h = dr.dot(normal, half), dr.maximum(dr.dot(view, half), 0)
    α2 = dr.square(dr.square(roughness))
    density = α2 / (dr.pi * dr.square(dr.fma(dr.square(n_h), α2 - 1, 1)))
    fresnel = DIELECTRIC_F0 + (1 - DIELECTRIC_F0) * dr.exp2((-5.55473 * v_h - 6.98316) * v_h)
    k = dr.square(roughness + 1) / 8
    # G / (4 n·l n·v) of Smith-Schlick, without the cosines that cancel.
    shadowing = dr.rcp(4 * dr.lerp(n_v, 1, k) * dr.lerp(n_l, 1, k))
    return dr.select(n_v > 0, density * fresnel * shadowing, 0)
