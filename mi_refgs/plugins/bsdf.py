"""The `refgs_bsdf` BSDF, for path tracers: the reflectance model that `mi_refgs.shade` approximates."""

import math
import textwrap
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import require_supported_variant
from mi_refgs.shade.brdf import device_table, split_sum
from mi_refgs.shade.reflectance.split_sum import DIELECTRIC_F0
from mi_refgs.types import Color3f, Float

ROUGHNESS_FLOOR = 0.01  # α = 1e-4, Mitsuba's smallest; below, reflectance changes by < 3e-5
SPECULAR, DIFFUSE = 0, 1  # indices of the components

LOBES = mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection


@dataclass(frozen=True)
class Material:
    """Parameters at surface points, all of one width."""

    f0: Color3f  # reflectance at normal incidence
    base: Color3f  # (1 - metallic) albedo: reflectance of the diffuse base under the specular layer
    roughness: Float

    def specular(self, cosine: Float) -> Color3f:
        """Reflectance of the specular component under constant light, viewed at this cosine."""
        scale, bias = split_sum(cosine, self.roughness)
        return dr.fma(self.f0, scale, bias)

    def diffuse(self, cosine: Float) -> Color3f:
        return dr.maximum(1 - self.specular(cosine), 0) * self.base

    def distribution(self) -> Any:
        """GGX; Mitsuba's own shadowing, which is separable, is not used."""
        return mi.MicrofacetDistribution(mi.MicrofacetType.GGX, dr.square(self.roughness), True)

    def slope(self, cosine: Float) -> Float:
        """cosθ (1 + 2 Λ(θ)) of Smith's Λ, finite at cosθ = 0."""
        return dr.sqrt(dr.lerp(dr.square(dr.square(self.roughness)), 1, dr.square(cosine)))


class RefGSBSDF(mi.BSDF):
    r"""
    The reflectance of the surfels, for Mitsuba's path tracers.

    .. pluginparameters::

     * albedo (spectrum or texture, differentiable): Diffuse reflectance, or that of a metal at normal
       incidence; 0 to 1. (Default: 0.5)
     * metallic (float or texture, differentiable): From 0, a dielectric that reflects 0.04 at normal
       incidence, to 1, a metal without diffuse reflection. (Default: 0)
     * roughness (float or texture, differentiable): In (0, 1]; GGX's α is its square. Below 0.01 it counts as
       0.01, above 1 as 1. (Default: 0.5)

    The `refgs` integrator (``reflectance = split_sum``, ``diffuse = irradiance``) approximates the integral
    of the light times

    .. math::

        f = (1 - E(n \cdot v)) (1 - m) \frac{a}{\pi} + \frac{D\,G\,F}{4 (n \cdot v) (n \cdot l)}, \quad
        F = F_0 + (1 - F_0) (1 - v \cdot h)^5, \quad F_0 = 0.04 (1 - m) + a\,m

    with GGX's D, and the height-correlated G of Smith [Heitz 2014, "Understanding the Masking-Shadowing
    Function", eqs. 72, 99]. E, per channel, is the specular reflectance under constant light, from the
    split-sum table. No material reflects more than it receives, but for the table's error (1e-3; up to 0.11
    at n · v below 0.005 and roughness below 0.15). The diffuse term is not reciprocal: E depends on v alone,
    which is wo for paths that start at a light (``TransportMode.Importance``).

    It reflects on the side of the normal only: nest it in a `twosided` for open meshes. Component 0 is the
    specular reflection, 1 the diffuse one. Load maps of metallic and roughness with ``raw = true``.

    `eval`, and the weight that `sample` returns, have derivatives with respect to the parameters and the
    directions; samples, of the visible normals [Heitz 2018] or the cosine, and densities have none."""

    def __init__(self, props: Any) -> None:
        require_supported_variant("refgs_bsdf")
        super().__init__(props)
        defaults = {"albedo": 0.5, "metallic": 0.0, "roughness": 0.5}
        self.textures = {name: _texture(props, name, default) for name, default in defaults.items()}
        self.m_components = [lobe | mi.BSDFFlags.FrontSide for lobe in LOBES]
        self.m_flags = self.m_components[SPECULAR] | self.m_components[DIFFUSE]
        device_table(mi.variant())  # loops and calls that are being recorded cannot make it

    def traverse(self, cb: Any) -> None:
        for name, texture in self.textures.items():
            cb.put(name, texture, mi.ParamFlags.Differentiable)

    def sample(self, ctx: Any, si: Any, sample1: Any, sample2: Any, active: Any = True) -> tuple[Any, Any]:
        wi, active = _front(si.wi, active)
        material = self._material(si, active)
        with dr.suspend_grad():
            specular = sample1 < _specular_probability(ctx, material, wi.z)
            normal, _ = material.distribution().sample(wi, sample2)
            cosine = mi.warp.square_to_cosine_hemisphere(sample2)
            sampled = dr.zeros(mi.BSDFSample3f, dr.width(wi))
            # Also below the surface, where a blend's other parts reflect nothing.
            sampled.wo = dr.select(specular, mi.reflect(wi, normal), cosine)
            wo, above = _front(sampled.wo, active)
            sampled.pdf = dr.select(above, _density(ctx, material, wi, wo), 0)
            sampled.eta = 1
            sampled.sampled_component = dr.select(specular, mi.UInt32(SPECULAR), mi.UInt32(DIFFUSE))
            sampled.sampled_type = dr.select(specular, *(mi.UInt32(lobe) for lobe in LOBES))
            valid = above & (sampled.pdf > 0)
            inverse = dr.rcp(dr.select(valid, sampled.pdf, 1))
        return sampled, dr.select(valid, _value(ctx, material, wi, wo) * inverse, 0)

    def eval(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[0]

    def pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> Any:
        return self.eval_pdf(ctx, si, wo, active)[1]

    def eval_pdf(self, ctx: Any, si: Any, wo: Any, active: Any = True) -> tuple[Any, Any]:
        """f cosθ, and the density of `sample` per solid angle without derivatives."""
        wi, active = _front(si.wi, active)
        wo, active = _front(wo, active)
        material = self._material(si, active)
        value = dr.select(active, _value(ctx, material, wi, wo), 0)
        with dr.suspend_grad():
            return value, dr.select(active, _density(ctx, material, wi, wo), 0)

    def eval_diffuse_reflectance(self, si: Any, active: Any = True) -> Any:
        return self._material(si, active).diffuse(dr.abs(si.wi.z))

    def _material(self, si: Any, active: Any) -> Material:
        albedo = mi.Color3f(self.textures["albedo"].eval(si, active))
        metallic = self.textures["metallic"].eval_1(si, active)
        roughness = dr.clip(self.textures["roughness"].eval_1(si, active), ROUGHNESS_FLOOR, 1)
        f0 = dr.fma(albedo - DIELECTRIC_F0, metallic, DIELECTRIC_F0)
        return Material(f0, (1 - metallic) * albedo, roughness)

    def to_string(self) -> str:
        lines = ",\n".join(f"{name} = {texture}" for name, texture in self.textures.items())
        return f"RefGSBSDF[\n{textwrap.indent(lines, '  ')}\n]"


def _texture(props: Any, name: str, default: float) -> Any:
    """A texture property; InputError for a constant out of range, or a colour where a number is needed."""
    value = props.get(name, default)
    colour = isinstance(value, mi.ScalarColor3d)
    if colour and name != "albedo":
        raise InputError(f"{value} is a colour", "refgs_bsdf", name, "give a number or a texture")
    numbers = value if colour else [value] if isinstance(value, int | float) else []
    positive = name == "roughness"
    if not all(0 <= x <= 1 and (x > 0 or not positive) for x in numbers):
        bounds = "(0, 1]" if positive else "[0, 1]"
        raise InputError(f"{value} is outside {bounds}", "refgs_bsdf", name, "give a value inside")
    return props.get_texture(name, default)


def _front(direction: Any, active: Any) -> tuple[Any, Any]:
    """Directions on the side of the normal, others replaced by the normal; and whether they are."""
    active = mi.Bool(active) & (direction.z > 0)
    return dr.select(active, direction, mi.Vector3f(0, 0, 1)), active


def _enabled(ctx: Any) -> tuple[bool, bool]:
    """Whether the context enables the specular and the diffuse component."""
    return ctx.is_enabled(LOBES[SPECULAR], SPECULAR), ctx.is_enabled(LOBES[DIFFUSE], DIFFUSE)


def _value(ctx: Any, material: Material, wi: Any, wo: Any) -> Any:
    """f cosθ of directions above the surface."""
    specular, diffuse = _enabled(ctx)
    value: Any = mi.Color3f(0)
    if specular:
        h = dr.normalize(wi + wo)
        # G / (4 cosθi cosθo) = ½ / (cosθo slope(cosθi) + cosθi slope(cosθo))
        shadowing = 0.5 * wo.z / (wo.z * material.slope(wi.z) + wi.z * material.slope(wo.z))
        grazing = dr.maximum(1 - dr.dot(wi, h), 0)
        fresnel = dr.fma(1 - material.f0, dr.square(dr.square(grazing)) * grazing, material.f0)  # Schlick's
        value += fresnel * (material.distribution().eval(h) * shadowing)
    if diffuse:
        view = wi if ctx.mode == mi.TransportMode.Radiance else wo
        value += material.diffuse(view.z) * (wo.z * (1 / math.pi))
    return value


def _density(ctx: Any, material: Material, wi: Any, wo: Any) -> Any:
    """Density of `sample` for directions above the surface."""
    choice = _specular_probability(ctx, material, wi.z)
    # D G1 (v·h) / cosθi, over dω_o / dω_h = 4 (v·h); G1 = 2 cosθi / (cosθi + slope(cosθi))
    visible = material.distribution().eval(dr.normalize(wi + wo)) * 0.5 / (wi.z + material.slope(wi.z))
    return dr.lerp(wo.z * (1 / math.pi), visible, choice) if any(_enabled(ctx)) else mi.Float(0)


def _specular_probability(ctx: Any, material: Material, cosine: Any) -> Any:
    """Probability of sampling the specular component: 0 or 1 if the context enables one only."""
    specular, diffuse = _enabled(ctx)
    if not (specular and diffuse):
        return mi.Float(specular)
    reflected = dr.maximum(dr.mean(material.specular(cosine)), 0)
    total = reflected + dr.maximum(dr.mean(material.diffuse(cosine)), 0)
    return dr.select(total > 0, reflected / dr.select(total > 0, total, 1), 1)


mi.register_bsdf("refgs_bsdf", RefGSBSDF)
