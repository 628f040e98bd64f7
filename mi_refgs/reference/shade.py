"""Shading in NumPy float64, point by point and by brute force: the specification that `mi_refgs.shade` is
tested against.

It shares no code with it: other formulas for the spherical harmonics, plain quadrature for the split sum and
for the lobe, plain lookups. Directions are (3,) arrays, colours too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mi_refgs.reference.lobe import frame, reflected, schlick, smith_lambda


def split_sum(n_dot_v: float, roughness: float, nodes: int = 1500) -> tuple[float, float]:
    """(A, B) of one pair by midpoints over the half vectors: GGX α = roughness², correlated Smith,
    Schlick."""
    α2 = roughness**4
    ξ = 1 - ((np.arange(nodes) + 0.5) / nodes)[:, None] ** 2
    weight = 2 * np.sqrt(1 - ξ) / nodes
    tan2 = α2 * ξ / (1 - ξ)
    n_h = 1 / np.sqrt(1 + tan2)
    φ = (np.arange(nodes // 4) + 0.5) * (math.pi / (nodes // 4))
    v_h = n_dot_v * n_h + math.sqrt(1 - n_dot_v**2) * np.sqrt(1 - n_h**2) * np.cos(φ)
    n_l = 2 * v_h * n_h - n_dot_v
    lit = n_l > 0
    n_l = np.where(lit, n_l, 1)
    g = 1 / (1 + smith_lambda(n_dot_v, roughness**2) + smith_lambda(n_l, roughness**2))
    value = np.where(lit, weight * g * v_h / (n_h * n_dot_v), 0) / len(φ)
    schlick = (1 - v_h) ** 5
    return float((value * (1 - schlick)).sum()), float((value * schlick).sum())


def sh_basis(direction: np.ndarray, degree: int) -> np.ndarray:
    """Real spherical harmonics (…, (degree + 1)²) of unit directions (…, 3), with the Condon-Shortley phase.

    Legendre functions over sin^m θ by recursion; complex steps give derivatives.
    """
    x, y, z = np.moveaxis(direction, -1, 0)
    cos, sin = [np.ones_like(x)], [np.zeros_like(x)]  # sin^m θ cos mφ, sin^m θ sin mφ
    for _ in range(degree):
        cos, sin = [*cos, x * cos[-1] - y * sin[-1]], [*sin, x * sin[-1] + y * cos[-1]]
    p = {(0, 0): np.ones_like(z)}
    for m in range(1, degree + 1):
        p[m, m] = -(2 * m - 1) * p[m - 1, m - 1]
    for m in range(degree):
        p[m + 1, m] = (2 * m + 1) * z * p[m, m]
        for n in range(m + 2, degree + 1):
            p[n, m] = ((2 * n - 1) * z * p[n - 1, m] - (n + m - 1) * p[n - 2, m]) / (n - m)
    out = []
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            turn = 1 if m == 0 else math.sqrt(2) * (cos[k] if m > 0 else sin[k])
            out.append(norm * p[n, k] * turn)
    return np.stack(out, axis=-1)


def bilinear(radiance: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Look up a lat-long map (h, w, 3) in unit directions (…, 3), as Mitsuba's `envmap` does.

    Column centres are at half-integers, the first and last rows on the poles.
    """
    h, w = radiance.shape[:2]
    x, y, z = np.moveaxis(direction, -1, 0)
    u = np.arctan2(x, -z) / (2 * math.pi) % 1.0 * w - 0.5
    v = np.arccos(np.clip(y, -1, 1)) / math.pi * (h - 1)
    j, i = np.floor(u).astype(int), np.minimum(np.floor(v).astype(int), h - 2)
    s, t = (u - j)[..., None], (v - i)[..., None]
    upper = (1 - s) * radiance[i, j % w] + s * radiance[i, (j + 1) % w]
    lower = (1 - s) * radiance[i + 1, j % w] + s * radiance[i + 1, (j + 1) % w]
    return (1 - t) * upper + t * lower


def lobe_average(
    radiance: np.ndarray, direction: np.ndarray, roughness: float, *, rings: int = 400, spokes: int = 400
) -> np.ndarray:
    """∫ L W / ∫ W with W = max(L·R, 0) D(R·H), in polar coordinates around R: even rings in the core, wider
    in the tail."""
    α = roughness**2
    pole = np.asarray(direction, np.float64) / np.linalg.norm(direction)
    side, up, _ = frame(pole)
    φ = (np.arange(spokes) + 0.5) * (2 * math.pi / spokes)
    around = np.cos(φ)[:, None] * side + np.sin(φ)[:, None] * up
    total, weights = np.zeros(3), 0.0
    end = math.asinh(1 / α)  # tan θ_h = 1 puts L on the horizon
    for n in range(rings):
        t = end * (n + 0.5) / rings
        half = math.atan(α * math.sinh(t))
        d = α**2 / (math.cos(half) ** 2 * (α**2 - 1) + 1) ** 2
        width = α * math.cosh(t) * math.cos(half) ** 2  # dθ_h / dt
        # dω_l = 4 cosθ_h dω_h
        weight = math.cos(2 * half) * d * math.cos(half) * math.sin(half) * width
        total += weight * bilinear(radiance, math.cos(2 * half) * pole + math.sin(2 * half) * around).mean(0)
        weights += weight
    return total / weights


def specular(
    levels: Sequence[np.ndarray], roughnesses: Sequence[float], direction: np.ndarray, roughness: float
) -> np.ndarray:
    """Lookup between levels (the map first, then one a roughness): linear in 1/r, in r⁴ below the first
    roughness."""
    if roughness <= roughnesses[0]:
        lower, t = 0, (roughness / roughnesses[0]) ** 4
    else:
        lower = max(n for n, r in enumerate(roughnesses[:-1]) if roughness > r) + 1
        a, b = roughnesses[lower - 1], roughnesses[lower]
        t = (1 / roughness - 1 / a) / (1 / b - 1 / a)
    return (1 - t) * bilinear(levels[lower], direction) + t * bilinear(levels[lower + 1], direction)


def clip(x: float | np.ndarray, low: float, high: float) -> np.ndarray:
    """Clip real parts; complex numbers outside lose their derivative."""
    return np.where(np.real(x) < low, low, np.where(np.real(x) > high, high, x))


def table_lookup(table: np.ndarray, n_dot_v: float | np.ndarray, roughness: float | np.ndarray) -> np.ndarray:
    """Bilinear (A, B) (…, 2) in a table [roughness, N·V], texel centres, outer half texels extrapolated."""
    n = len(table)
    x, y = clip(n_dot_v, 0, 1) * n - 0.5, clip(roughness, 0, 1) * n - 0.5
    j, i = (np.clip(np.floor(q.real), 0, n - 2).astype(int) for q in (x, y))
    s, t = (x - j)[..., None], (y - i)[..., None]
    upper = (1 - s) * table[i, j] + s * table[i, j + 1]
    lower = (1 - s) * table[i + 1, j] + s * table[i + 1, j + 1]
    return (1 - t) * upper + t * lower


def shade(
    table: np.ndarray,
    levels: Sequence[np.ndarray],
    roughnesses: Sequence[float],
    *,
    normal: np.ndarray,
    view: np.ndarray,
    albedo: np.ndarray,
    metallic: float,
    roughness: float,
    radiance: np.ndarray,
    visibility: float | None,
    indirect: np.ndarray | None,
    diffuse: str,
    ambient: np.ndarray | None = None,
    dominant: bool = False,
    multiscatter: bool = False,
) -> np.ndarray:
    """Terms (3, 3) of one point: diffuse, specular, indirect."""
    n, v = normal / np.linalg.norm(normal), view / np.linalg.norm(view)
    a, b = table_lookup(table, float(n @ v), roughness)
    f0 = 0.04 * (1 - metallic) + albedo * metallic
    reflectance = f0 * a + b
    direction = 2 * (n @ v) * n - v
    if dominant:
        direction = dominant_direction(n, direction, roughness)
    reflected = specular(levels, roughnesses, direction, roughness) * reflectance
    if multiscatter:
        further = multiple_scattering(f0, a, b)
        reflected = reflected + further * bilinear(levels[-1], n)
        reflectance = reflectance + further
    visible = 1.0 if visibility is None else visibility
    out = np.zeros((3, 3))
    arriving = bilinear(levels[-1], n) * (1.0 if ambient is None else ambient)
    out[0] = (1 - metallic) * (
        radiance if diffuse == "sh" else np.maximum(1 - reflectance, 0) * albedo * arriving
    )
    out[1] = visible * reflected
    if visibility is not None and indirect is not None:
        out[2] = (1 - visible) * indirect * reflectance
    return out


def dominant_direction(normal: np.ndarray, mirror: np.ndarray, roughness: float) -> np.ndarray:
    """Normalised lerp from normal to mirror by (1 - α)(√(1 - α) + α), α = roughness². [Lagarde and
    de Rousiers 2014, §4.9.3]"""
    α = roughness**2
    mixed = normal + (1 - α) * (math.sqrt(1 - α) + α) * (mirror - normal)
    return mixed / np.linalg.norm(mixed)


def multiple_scattering(f0: np.ndarray, a: float, b: float, bounces: int = 400) -> np.ndarray:
    """Σ_{n ≥ 1} (F0 a + b) (F (1 - a - b))ⁿ with Schlick's mean F, bounce by bounce. [Fdez-Agüera 2019]"""
    fresnel = f0 + (1 - f0) / 21
    return (f0 * a + b) * sum((fresnel * (1 - a - b)) ** n for n in range(1, bounces))


def diffuse_reflectance(
    albedo: np.ndarray, metallic: float, roughness: float, n_dot_v: float, nodes: int = 400
) -> np.ndarray:
    """(1 - F0 A - B) (1 - metallic) albedo, (3,): what the base reflects of what the specular layer leaves;
    0 from behind."""
    if n_dot_v <= 0:
        return np.zeros(3)
    a, b = split_sum(n_dot_v, roughness, nodes)
    f0 = 0.04 * (1 - metallic) + albedo * metallic
    return (1 - f0 * a - b) * (1 - metallic) * albedo


def brdf_cosine(
    albedo: np.ndarray,
    metallic: float,
    roughness: float,
    normal: np.ndarray,
    view: np.ndarray,
    lights: np.ndarray,
) -> np.ndarray:
    """BRDF times n·l, (n, 3), for unit directions `lights` (n, 3): `specular_cosine`, and
    `diffuse_reflectance` / π; zero below the horizon."""
    base = diffuse_reflectance(albedo, metallic, roughness, float(normal @ view))
    specular = specular_cosine(albedo, metallic, roughness, normal, view, lights)
    return specular + np.maximum(lights @ normal, 0)[:, None] * base / math.pi


def specular_cosine(
    albedo: np.ndarray,
    metallic: float,
    roughness: float,
    normal: np.ndarray,
    view: np.ndarray,
    lights: np.ndarray,
) -> np.ndarray:
    """The specular part: GGX α = roughness², correlated Smith, Schlick."""
    α2 = roughness**4
    n_l, n_v = lights @ normal, float(normal @ view)
    lit = (n_l > 0) & (n_v > 0)
    half = np.where(lit[:, None], lights + view, normal)
    half = half / np.linalg.norm(half, axis=1, keepdims=True)
    n_h, v_h = half @ normal, half @ view
    d = α2 / (math.pi * (n_h**2 * (α2 - 1) + 1) ** 2)
    safe, n_v = np.where(lit, n_l, 1), n_v if n_v > 0 else 1.0
    g = 1 / (1 + smith_lambda(safe, roughness**2) + smith_lambda(n_v, roughness**2))
    fresnel = schlick(v_h, 0.04 * (1 - metallic) + albedo * metallic)
    return np.where(lit, n_l, 0)[:, None] * fresnel * (d * g / (4 * safe * n_v))[:, None]


def reflected_radiance(
    radiance: np.ndarray,
    albedo: np.ndarray,
    metallic: float,
    roughness: float,
    normal: np.ndarray,
    view: np.ndarray,
    *,
    nodes: int = 400,
) -> np.ndarray:
    """∫ L f cosθ dω (3,) of a lat-long map under `brdf_cosine`, by midpoints: see `lobe.reflected` for the
    specular part; the diffuse part over cos²θ."""
    s, turn = (x.ravel() for x in np.meshgrid(*[(np.arange(nodes) + 0.5) / nodes] * 2))
    φ = 2 * math.pi * turn
    local = np.stack([np.sqrt(1 - s) * np.cos(φ), np.sqrt(1 - s) * np.sin(φ), np.sqrt(s)], axis=1)
    base = diffuse_reflectance(albedo, metallic, roughness, float(normal @ view))
    diffuse = base * bilinear(radiance, local @ frame(normal)).mean(0)
    f0 = 0.04 * (1 - metallic) + albedo * metallic
    return diffuse + reflected(lambda d: bilinear(radiance, d), normal, view, roughness, f0, nodes)
