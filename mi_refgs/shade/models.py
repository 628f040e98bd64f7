"""Shading: from points with materials, under a prefiltered light, to named terms of outgoing radiance.

One function for every order of work: at pixels (deferred) and at surfels (forward) the same points come in
and the same terms go out. [Reflective Gaussian Splatting, §3.2-3.3; split sum: Karis 2013]
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import NORM_FLOOR
from mi_refgs.errors import InputError
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.envmap import PrefilteredLight

DIELECTRIC_F0 = 0.04
"""Reflectance at normal incidence of a surface that is not metal (index of refraction 1.5)."""

Diffuse = Literal["sh", "irradiance"]


@dataclass(frozen=True)
class ShadingPoints:
    """N points to shade, all arrays of width N; what a scene does not use is None and costs nothing."""

    normal: mi.Vector3f  # world frame, any length
    view: mi.Vector3f  # world frame, any length, towards the camera
    albedo: mi.Color3f  # 0 … 1: diffuse reflectance, or F0 of a metal
    metallic: mi.Float  # 0 … 1
    roughness: mi.Float  # 0 … 1, α = roughness²
    radiance: mi.Color3f | None = None  # diffuse radiance as fitted (spherical harmonics), for diffuse="sh"
    visibility: mi.Float | None = None  # 0 … 1: does light arrive along the reflected direction?
    indirect: mi.Color3f | None = None  # radiance from there when it does not


@dataclass(frozen=True)
class Terms:
    """Outgoing radiance by cause; the picture is their sum."""

    diffuse: mi.Color3f
    specular: mi.Color3f
    indirect: mi.Color3f

    def total(self) -> mi.Color3f:
        """Sum of the terms."""
        return self.diffuse + self.specular + self.indirect


def safe_normalize(v: mi.Vector3f) -> mi.Vector3f:
    """v / |v|, and (0, 0, 1) with zero gradient where |v|² < NORM_FLOOR."""
    # Scaling by the largest component first keeps the square of a huge or tiny vector inside float32.
    largest = dr.detach(dr.maximum(dr.maximum(dr.abs(v.x), dr.abs(v.y)), dr.abs(v.z)))
    valid = largest > NORM_FLOOR**0.5
    scaled = dr.select(valid, v * dr.rcp(dr.select(valid, largest, 1)), mi.Vector3f(0, 0, 1))
    return scaled * dr.rsqrt(dr.squared_norm(scaled))


def reflect(view: mi.Vector3f, normal: mi.Vector3f) -> mi.Vector3f:
    """Mirror direction 2 (n·v) n - v of unit vectors that both point away from the surface."""
    return dr.fma(2 * dr.dot(normal, view), normal, -view)


def shade(points: ShadingPoints, light: PrefilteredLight, diffuse: Diffuse = "sh") -> Terms:
    """Outgoing radiance towards the camera, by cause.

    With F0 = 0.04 (1 - metallic) + albedo metallic, S = F0 A(n·v, roughness) + B and the reflected direction
    r: specular = V L(r, roughness) S, indirect = (1 - V) L_indirect S, and diffuse = (1 - metallic) radiance
    ("sh") or (1 - metallic) albedo irradiance(n) ("irradiance"). n·v is clamped to [0, 1]: a point seen from
    behind keeps its mirror direction, with the reflectance at grazing incidence.

    Differentiable in everything but the branches of the clamps. Finite for every finite input.
    Raises InputError for an unknown `diffuse`, or "sh" without a radiance.
    """
    normal, view = safe_normalize(points.normal), safe_normalize(points.view)
    f0 = dr.fma(points.albedo - DIELECTRIC_F0, points.metallic, DIELECTRIC_F0)
    scale, bias = split_sum(dr.dot(normal, view), points.roughness)
    reflectance = dr.fma(f0, scale, bias)
    specular = light.specular(reflect(view, normal), points.roughness) * reflectance
    indirect: Any = mi.Color3f(0)
    if points.visibility is not None:
        specular *= points.visibility
        if points.indirect is not None:
            indirect = (1 - points.visibility) * points.indirect * reflectance
    return Terms(_diffuse(points, normal, light, diffuse), specular, indirect)


def _diffuse(points: ShadingPoints, normal: Any, light: PrefilteredLight, diffuse: Diffuse) -> Any:
    if diffuse == "irradiance":
        return (1 - points.metallic) * points.albedo * light.irradiance(normal)
    if diffuse != "sh":
        raise InputError(f'shade: diffuse: "{diffuse}" is unknown; choose "sh" or "irradiance"')
    if points.radiance is None:
        raise InputError('shade: radiance: missing; diffuse="sh" needs it, diffuse="irradiance" does not')
    return (1 - points.metallic) * points.radiance
