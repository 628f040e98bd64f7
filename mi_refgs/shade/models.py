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
from mi_refgs.errors import InputError, shown
from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.envmap import PrefilteredLight

DIELECTRIC_F0 = 0.04
"""Reflectance at normal incidence of a surface that is not metal (index of refraction 1.5)."""

SMOOTHNESS_FLOOR = 1e-12
"""Below it √(1 - α), whose slope is infinite at α = 1, is held: its factor is below 1e-12 there."""

MEAN_FRESNEL_MAX = 1.25
"""The mean of Schlick's term is at most 1 for a colour in 0 … 1; this cap, out of its reach, keeps the series
of bounces finite for any other colour: A + B ≥ 0.31 everywhere."""

MAX_RAYS = 4096
"""Rays of the lobe, or bounces, beyond which nothing changes but the time: the length of a kernel follows."""

Diffuse = Literal["sh", "irradiance"]


@dataclass(frozen=True)
class Accuracy:
    """What to pay for a smaller error; everything is off by default, and costs nothing then.

    `shade` knows the first two, `render.pipeline` the others. Raises InputError for a value out of range.
    """

    dominant: bool = False  # look light up along the lobe's dominant direction, not the mirror direction
    multiscatter: bool = False  # add the light that leaves after several bounces between facets
    visibility_rays: int = 1  # rays of the GGX lobe that the visibility is averaged over; 1: the mirror ray
    traced_bounces: int = 0  # times that what a blocked ray hits is shaded, in place of the indirect channel

    def __post_init__(self) -> None:
        for name in ("dominant", "multiscatter"):
            if not isinstance(getattr(self, name), bool):
                raise InputError(f"accuracy: {name}: {shown(getattr(self, name))} is neither True nor False")
        for name, what, least in (("visibility_rays", "rays", 1), ("traced_bounces", "bounces", 0)):
            number: Any = getattr(self, name)
            if type(number) is not int or not least <= number <= MAX_RAYS:
                some = ", ".join(str(least + i) for i in range(3))
                raise InputError(
                    f"accuracy: {name}: {shown(number)} is no number of {what}; use {some}, … {MAX_RAYS}"
                )


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


def base_reflectance(points: ShadingPoints) -> mi.Color3f:
    """F0: reflectance at normal incidence, between a dielectric's and the metal's albedo."""
    return dr.fma(points.albedo - DIELECTRIC_F0, points.metallic, DIELECTRIC_F0)


def dominant_direction(normal: mi.Vector3f, mirror: mi.Vector3f, roughness: mi.Float) -> mi.Vector3f:
    """Unit direction near the peak of the GGX lobe, cosine and shadowing included; unit vectors in.

    With α = roughness² and s = 1 - α it lies s (√s + α) of the way from the normal to the mirror direction.
    Differentiable, but for the clamp of roughness to [0, 1]. [Lagarde and de Rousiers 2014, "Moving Frostbite
    to Physically Based Rendering", §4.9.3; of its two fits the one that it recommends with a prefiltered map]
    """
    α = dr.square(dr.clip(roughness, 0, 1))
    smooth = 1 - α
    mirrored = smooth * (dr.sqrt(dr.maximum(smooth, SMOOTHNESS_FLOOR)) + α)
    return safe_normalize(dr.lerp(normal, mirror, mirrored))


def lookup_direction(
    normal: mi.Vector3f, view: mi.Vector3f, roughness: mi.Float, accuracy: Accuracy
) -> mi.Vector3f:
    """Where the prefiltered light is looked up: mirror direction, or the dominant one. Unit vectors in."""
    mirror = reflect(view, normal)
    return dominant_direction(normal, mirror, roughness) if accuracy.dominant else mirror


def multiple_scattering(f0: mi.Color3f, single: mi.Color3f, energy: mi.Float) -> mi.Color3f:
    """What light that bounced more than once between facets adds to the reflectance under diffuse light.

    `single` = F0 A + B leaves after one bounce and `energy` = A + B would if nothing were absorbed; the rest
    bounces on, each time by the mean of Schlick's term, F0 + (1 - F0) / 21: single F E / (1 - F E) with
    E = 1 - energy. A white metal then returns all light. [Fdez-Agüera 2019, "A Multiple-Scattering Microfacet
    Model for Real-Time Image Based Lighting"] Its diffuse term is that of `shade` here.
    """
    fresnel = dr.clip(dr.fma(f0, 20 / 21, 1 / 21), 0, MEAN_FRESNEL_MAX)
    again = (1 - energy) * fresnel
    return single * again * dr.rcp(1 - again)


def shade(
    points: ShadingPoints,
    light: PrefilteredLight,
    diffuse: Diffuse = "sh",
    accuracy: Accuracy = Accuracy(),
) -> Terms:
    """Outgoing radiance towards the camera, by cause.

    With F0 = 0.04 (1 - metallic) + albedo metallic, S = F0 A(n·v, roughness) + B and the reflected direction
    r: specular = V L(r, roughness) S, indirect = (1 - V) L_indirect S, and diffuse = (1 - metallic) radiance
    ("sh") or (1 - S) (1 - metallic) albedo irradiance(n) ("irradiance"). n·v is clamped to [0, 1]: a point
    seen from behind keeps its mirror direction, with the reflectance at grazing incidence.

    `accuracy.dominant` turns r to `dominant_direction`; with `accuracy.multiscatter` and M of
    `multiple_scattering`, specular = V (L(r, roughness) S + irradiance(n) M),
    indirect = (1 - V) L_indirect (S + M), and diffuse has the factor 1 - S - M.

    Under a constant light of 1 no more than 1 leaves with "irradiance": S + (1 - S) (1 - metallic) albedo.
    This is the albedo scaling of layered models, a specular layer over a diffuse base; it is not reciprocal,
    as 1 - S depends on the view and not on the light. A fitted radiance ("sh") is outgoing and is not scaled.

    Differentiable in everything but the branches of the clamps. Finite for every finite input.
    Raises InputError for an unknown `diffuse`, or "sh" without a radiance.
    """
    normal, view = safe_normalize(points.normal), safe_normalize(points.view)
    f0 = base_reflectance(points)
    scale, bias = split_sum(dr.dot(normal, view), points.roughness)
    reflectance = dr.fma(f0, scale, bias)
    direction = lookup_direction(normal, view, points.roughness, accuracy)
    specular = light.specular(direction, points.roughness) * reflectance
    if accuracy.multiscatter:
        further = multiple_scattering(f0, reflectance, scale + bias)
        specular += light.irradiance(normal) * further
        reflectance += further
    indirect: Any = mi.Color3f(0)
    if points.visibility is not None:
        specular *= points.visibility
        if points.indirect is not None:
            indirect = (1 - points.visibility) * points.indirect * reflectance
    return Terms(_diffuse(points, normal, light, diffuse, reflectance), specular, indirect)


def _diffuse(
    points: ShadingPoints, normal: Any, light: PrefilteredLight, diffuse: Diffuse, reflectance: Any
) -> Any:
    if diffuse == "irradiance":
        # The table, extrapolated, exceeds 1 by up to 1e-4: no negative light from that.
        left = dr.maximum(1 - reflectance, 0)
        return left * (1 - points.metallic) * points.albedo * light.irradiance(normal)
    if diffuse != "sh":
        raise InputError(f'shade: diffuse: "{diffuse}" is unknown; choose "sh" or "irradiance"')
    if points.radiance is None:
        raise InputError('shade: radiance: missing; diffuse="sh" needs it, diffuse="irradiance" does not')
    return (1 - points.metallic) * points.radiance
