"""The GGX lobe by brute force in float64: α = roughness², height-correlated Smith, Schlick. Directions are
unit (3,) or (n, 3) arrays that point away from the surface; colours have three channels."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

Array = np.ndarray
Incoming = Callable[[Array], Array]  # radiance (n, 3), or any (n, c), from unit directions (n, 3)
Hit = Callable[[Array, Array], "tuple[Array, Array, Any] | None"]
"""Where a ray (origin, direction) first ends: place, unit normal against the ray, and any other thing."""

Outgoing = Callable[[Any, Array, Array, float, Array], Array]  # radiance (3,): see `chain`


def smith_lambda(cosine: float | Array, α: float) -> Array:
    """Smith's Λ of GGX; of directions below the horizon too. [Heitz et al. 2016, eq. 15 ff.]"""
    cosine = np.where(np.abs(cosine) < 1e-9, 1e-9, cosine)
    return (np.sign(cosine) * np.sqrt(1 + α**2 * (1 / np.square(cosine) - 1)) - 1) / 2


def frame(normal: Array) -> Array:
    """Rotation (3, 3) whose rows are two tangents and the unit normal."""
    helper = np.eye(3)[np.argmin(np.abs(normal))]
    side = np.cross(helper, normal)
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(normal, side), normal])


def half_vectors(roughness: float, rings: int, spokes: int) -> tuple[Array, Array]:
    """Half vectors (n, 3) around +z and weights (n,), midpoints of the density D cosθ; rings even in θ."""
    y = ((np.arange(rings) + 0.5) / rings)[:, None]
    s = 1 - y**2
    n_h = np.sqrt(s**2 / (s**2 + roughness**4 * (1 - s**2)))
    sin_h = np.sqrt(1 - n_h**2)
    φ = (np.arange(spokes) + 0.5) * (2 * math.pi / spokes)
    half = np.stack(np.broadcast_arrays(sin_h * np.cos(φ), sin_h * np.sin(φ), n_h), -1).reshape(-1, 3)
    return half, np.broadcast_to(4 * s * y / (rings * spokes), (rings, spokes)).ravel()


def lobe_average(incoming: Incoming, direction: Array, roughness: float, nodes: int = 400) -> Array:
    """∫ L W / ∫ W with W = max(L·R, 0) D(R·H) of a unit direction R; dω_l = 4 cosθ_h dω_h."""
    half, share = half_vectors(roughness, nodes, nodes)
    light = 2 * half[:, 2:] * half - np.array([0, 0, 1])
    weight = share * np.maximum(light[:, 2], 0)
    return np.asarray(weight @ incoming(light @ frame(direction)) / weight.sum())


def lobe_nodes(
    normal: Array, view: Array, roughness: float, rings: int = 200, spokes: int = 200
) -> tuple[Array, Array, Array]:
    """Directions (n, 3), cosines of view and half vector (n,), and weights (n,), with Σ weight F(cosine)
    L(direction) = ∫ f L cosθ dω: midpoints over the half vectors, drawn from D cosθ."""
    half, share = half_vectors(roughness, rings, spokes)
    rotation = frame(normal)
    local = rotation @ view
    v_h = half @ local
    light = 2 * v_h[:, None] * half - local
    lit = (light[:, 2] > 0) & (v_h > 0)
    half, light, v_h, share = half[lit], light[lit], v_h[lit], share[lit]
    α = roughness**2
    g = 1 / (1 + smith_lambda(local[2], α) + smith_lambda(light[:, 2], α))
    return light @ rotation, v_h, share * g * v_h / (half[:, 2] * local[2])


def schlick(cosine: Array, f0: Array) -> Array:
    """Fresnel reflectance (n, c) of cosines (n,) and F0 (c,)."""
    return f0 + (1 - f0) * (1 - cosine[:, None]) ** 5


def reflected(
    incoming: Incoming, normal: Array, view: Array, roughness: float, f0: Array, nodes: int = 200
) -> Array:
    """∫ f L cosθ dω (3,): what a GGX surface reflects of any incoming light, with no approximation."""
    direction, v_h, weight = lobe_nodes(normal, view, roughness, nodes, nodes)
    return (weight[:, None] * schlick(v_h, f0) * incoming(direction)).sum(0)


def split_sum_entry(n_dot_v: float, roughness: float, nodes: int = 800) -> tuple[float, float]:
    """(A, B) with ∫ f cosθ dω = A F0 + B at one cosine: an entry of the split-sum table."""
    view = np.array([math.sqrt(1 - n_dot_v**2), 0, n_dot_v])
    _, v_h, weight = lobe_nodes(np.array([0, 0, 1.0]), view, roughness, nodes, nodes // 8)
    fresnel = (1 - v_h) ** 5
    return float(weight @ (1 - fresnel)), float(weight @ fresnel)


def normal_reflectance(albedo: Array, metallic: float | Array) -> Array:
    """F0 of a dielectric of 4 % or a metal of its albedo, or a mixture."""
    return 0.04 * (1 - metallic) + albedo * metallic


def diffuse_reflectance(albedo: Array, metallic: float, roughness: float, n_dot_v: float) -> Array:
    """(1 - F0 A - B) (1 - metallic) albedo, (3,): what the base reflects of the rest; 0 from behind."""
    if n_dot_v <= 0:
        return np.zeros(3)
    a, b = split_sum_entry(n_dot_v, roughness, 400)
    return (1 - normal_reflectance(albedo, metallic) * a - b) * (1 - metallic) * albedo


def brdf_cosine(
    albedo: Array, metallic: float, roughness: float, normal: Array, view: Array, lights: Array
) -> Array:
    """BRDF times n·l, (n, 3), for unit directions `lights` (n, 3); zero below the horizon."""
    α2 = roughness**4
    n_l, n_v = lights @ normal, float(normal @ view)
    lit = (n_l > 0) & (n_v > 0)
    half = np.where(lit[:, None], lights + view, normal)
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    n_h, v_h = half @ normal, half @ view
    d = α2 / (math.pi * (n_h**2 * (α2 - 1) + 1) ** 2)
    safe, n_v = np.where(lit, n_l, 1), n_v if n_v > 0 else 1.0
    g = 1 / (1 + smith_lambda(safe, roughness**2) + smith_lambda(n_v, roughness**2))
    specular = schlick(v_h, normal_reflectance(albedo, metallic)) * (d * g / (4 * safe * n_v))[:, None]
    base = diffuse_reflectance(albedo, metallic, roughness, float(normal @ view))
    return np.where(lit, n_l, 0)[:, None] * specular + np.maximum(n_l, 0)[:, None] * base / math.pi


def reflected_radiance(
    incoming: Incoming, albedo: Array, metallic: float, roughness: float, normal: Array, view: Array
) -> Array:
    """∫ L f cosθ dω (3,) under `brdf_cosine`, by midpoints: the diffuse part over cos²θ."""
    s, turn = (x.ravel() for x in np.meshgrid(*[(np.arange(400) + 0.5) / 400] * 2))
    φ = 2 * math.pi * turn
    local = np.stack([np.sqrt(1 - s) * np.cos(φ), np.sqrt(1 - s) * np.sin(φ), np.sqrt(s)], axis=1)
    base = diffuse_reflectance(albedo, metallic, roughness, float(normal @ view))
    diffuse = base * incoming(local @ frame(normal)).mean(0)
    return diffuse + reflected(incoming, normal, view, roughness, normal_reflectance(albedo, metallic), 400)


def traced_fraction(
    free: Incoming, normal: Array, view: Array, roughness: float, f0: float, nodes: int = 200
) -> float:
    """∫ V f cosθ dω / ∫ f cosθ dω of the visibility `free` (n, 1): where an average over k rays converges."""
    direction, v_h, weight = lobe_nodes(normal, view, roughness, nodes, nodes)
    weight = weight * schlick(v_h, np.array([f0]))[:, 0]
    return float((weight * free(direction)[:, 0]).sum() / weight.sum())


def chain(hit: Hit, outgoing: Outgoing, origin: Array, direction: Array, bounces: int) -> Array | None:
    """Radiance (3,) of what a ray meets, shaded with what its mirror ray meets, `bounces` surfaces in all and
    0 beyond; None if it meets nothing. `outgoing` takes normal, view, visibility (0 or 1) of the light along
    the mirror ray, and the radiance that arrives instead."""
    found = hit(origin, direction)
    if found is None:
        return None
    if bounces == 0:
        return np.zeros(3)
    point, normal, surface = found
    mirror = direction - 2 * float(direction @ normal) * normal
    beyond = chain(hit, outgoing, point, mirror, bounces - 1)
    arrives = np.zeros(3) if beyond is None else beyond
    return outgoing(surface, normal, -direction, float(beyond is None), arrives)


def blocked_mean(radiance: Array, weight: Array, blocked: Array, free: Array, fading: float) -> Array:
    """Weighted mean (3,) of radiance (k, 3) of k ≥ 2 rays that are `blocked` (k,), and `free` (3,) of others.
    Per colour, the largest product loses `fading` of what exceeds k times the mean of the others."""
    count, products = len(weight), weight[:, None] * np.where(blocked[:, None], radiance, free)
    for channel in range(3):
        first = int(np.argmax(np.where(blocked, products[:, channel], -1)))
        if blocked[first]:
            others = np.delete(products[:, channel], first)
            products[first, channel] -= fading * max(products[first, channel] - count * others.mean(), 0)
    return np.asarray(products[blocked].sum(0) / weight[blocked].sum())
