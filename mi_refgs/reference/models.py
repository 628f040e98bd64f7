"""Reflectance models in float64: of points and a light to three terms of radiance. `taps` collects lookups in
the light: texels, weights, and the factor of their sum."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.light import Light, bilinear, irradiance, seen_from, specular, table_lookup
from mi_refgs.reference.lobe import Array, normal_reflectance

Taps = list[tuple[Array, Array, Array]]

MATERIALS = ("albedo", "metallic", "roughness", "tint")


@dataclass(frozen=True)
class Options:
    """Choices of a shading beside its model."""

    diffuse: str = "sh"
    dominant: bool = False
    directions: int = 24  # of `monte_carlo`
    free: Array | None = None  # (n, directions): whether light arrives along them
    detached_normal: Array | None = None  # (n, 3): about which these are taken, where it is not the point's


@dataclass(frozen=True)
class Points:
    """Points to shade; arrays (n, …)."""

    normal: Array
    view: Array
    values: dict[str, Array]  # by name, such as albedo (n, 3), metallic and visibility (n, 1)
    position: Array | None = None  # in the world

    @staticmethod
    def of(values: dict[str, Any]) -> Points:
        """Points from arrays (n, …) by name, normal and view among them; what is None is left out."""
        found = {n: np.asarray(x, np.float64).reshape(len(x), -1) for n, x in values.items() if x is not None}
        return Points(found.pop("normal"), found.pop("view"), found)


Model = Callable[[Points, Light | None, Options, Taps], list[Array]]


def split_sum(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """GGX by a prefiltered light and a table, diffuse by SH or irradiance (`reflectance.split_sum`)."""
    assert light is not None
    n, v, values = unit(points.normal), unit(points.view), points.values
    albedo, metallic, roughness = values["albedo"], values["metallic"], values["roughness"][:, 0]
    n_v = np.sum(n * v, 1)
    a, b = table_lookup(light.table, n_v, roughness).T
    reflectance = normal_reflectance(albedo, metallic) * a[:, None] + b[:, None]
    free = values.get("visibility", np.ones((len(n), 1)))
    direction = 2 * n_v[:, None] * n - v
    if options.dominant:  # [Lagarde and de Rousiers 2014, §4.9.3]
        smooth = 1 - roughness[:, None] ** 2
        direction = unit(n + smooth * (np.sqrt(smooth) + 1 - smooth) * (direction - n))
    direction = seen_from(light, points.position, direction)
    reflected = _looked_up(light, specular(light, direction, roughness), free * reflectance, taps)
    if options.diffuse == "sh":
        scattered = (1 - metallic) * values["radiance"]
    else:
        base = positive(1 - reflectance) * (1 - metallic) * albedo * values.get("ambient", 1.0)
        scattered = _looked_up(light, irradiance(light, n), base, taps)
    blocked = np.zeros_like(scattered)
    if "visibility" in values and "indirect" in values:
        blocked = (1 - free) * positive(values["indirect"] + values.get("residual", 0)) * reflectance
    return [scattered, reflected, blocked]


def radiance(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """The SH colour alone."""
    return _terms(points.values["radiance"])


def displayed(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """The SH colour, decoded from sRGB."""
    encoded = points.values["radiance"]
    straight = encoded.real <= 0.04045
    curve = ((np.where(straight, 1, encoded) + 0.055) / 1.055) ** 2.4
    return _terms(np.where(straight, encoded / 12.92, curve))


def mirror(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of 3DGS-DR: the SH colour, and the light in the mirror direction."""
    assert light is not None
    n, v = unit(points.normal), unit(points.view)
    share = points.values["metallic"]
    direction = seen_from(light, points.position, 2 * np.sum(n * v, 1, keepdims=True) * n - v)
    reflected = _looked_up(light, bilinear(light, direction, np.zeros(len(n), int)), share, taps)
    return _terms((1 - share) * points.values["radiance"], reflected)


def gaussian_shader(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of GaussianShader: SH colour, diffuse light, and tinted specular light."""
    assert light is not None
    n, v, values = unit(points.normal), unit(points.view), points.values
    tint, roughness = values["tint"], values["roughness"][:, 0]
    cosine = np.sum(n * v, 1)
    scale, bias = table_lookup(light.table, cosine, roughness).T
    around = _looked_up(light, irradiance(light, n), 1 - tint, taps)
    lookup = specular(light, seen_from(light, points.position, 2 * cosine[:, None] * n - v), roughness)
    factor = tint * scale[:, None] + bias[:, None]
    return _terms(values["radiance"] + around, _looked_up(light, lookup, factor, taps))


def monte_carlo(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of R3DG: light of the environment and of surfaces nearby; the normal has no derivative."""
    assert light is not None
    values, v = points.values, unit(points.view)
    normal = unit(points.normal).real if options.detached_normal is None else options.detached_normal
    directions = np.stack([hemisphere(options.directions, n) for n in normal])
    base, r = 0.77 * values["albedo"] + 0.03, 0.9 * values["roughness"] + 0.09
    incident = values.get("incident")
    found = [np.zeros(base.shape, base.dtype) for _ in range(3)]
    for j in range(options.directions):
        w = directions[:, j]
        h = unit(v + w)
        n_l, n_v, n_h = (np.sum(normal * x, 1, keepdims=True) for x in (w, v, h))
        v_h = np.sum(v * h, 1, keepdims=True)
        d = r**4 / (math.pi * (n_h**2 * (r**4 - 1) + 1) ** 2)
        f = 0.04 + 0.96 * 2 ** ((-5.55473 * v_h - 6.98316) * v_h)
        k = (r + 1) ** 2 / 8
        smith = 1 / ((n_v * (1 - k) + k) * (n_l * (1 - k) + k))
        f_s = np.where(n_v.real > 0, d * f * smith / 4, 0)
        weight = 2 * math.pi / options.directions * positive(n_l)
        free = 1.0 if options.free is None else options.free[:, j : j + 1]
        position = None if points.position is None else points.position.real
        lookup = bilinear(light, seen_from(light, position, w), np.zeros(len(w), int))
        for term, share in enumerate((base / math.pi, f_s)):
            found[term] = found[term] + _looked_up(light, lookup, free * weight * share, taps)
        if incident is not None:
            found[2] = found[2] + weight * (base / math.pi + f_s) * positive(harmonics(incident, w))
    return found


def hemisphere(count: int, normal: Array) -> Array:
    """Directions (count, 3) of a Fibonacci hemisphere about a unit normal (3,), at least 10° high. [frame:
    Duff et al. 2017, "Building an Orthonormal Basis, Revisited"]"""
    x, y, z = normal
    sign = math.copysign(1.0, z)
    a = -1 / (sign + z)
    s = np.array([1 + sign * x * x * a, sign * x * y * a, -sign * x])
    t = np.array([x * y * a, sign + y * y * a, -y])
    out = []
    for j in range(count):
        height = max(1 - (j + 0.5) / count, math.sin(math.radians(10)))
        φ = math.pi * (3 - math.sqrt(5)) * j
        radius = math.sqrt(1 - height**2)
        out.append(radius * math.cos(φ) * s + radius * math.sin(φ) * t + height * normal)
    return np.array(out)


MODELS: dict[str, Model] = {
    model.__name__: model for model in (split_sum, radiance, mirror, gaussian_shader, monte_carlo, displayed)
}


def _looked_up(light: Light, lookup: tuple[Array, Array], factor: Array, taps: Taps) -> Array:
    """`factor` (n, …) times the light (n, 3) of a lookup."""
    texel, weight = lookup
    taps.append((texel, weight, np.broadcast_to(factor, (len(texel), 3))))
    return factor * light.look_up(texel, weight)


def _terms(*known: Array) -> list[Array]:
    """The three terms, zero where there is none."""
    return [*known, *(np.zeros_like(known[0]) for _ in range(3 - len(known)))]


def harmonics(coefficients: Array, direction: Array) -> Array:
    """Σ c_k Y_k (n, 3) of coefficients (n, 3 (degree + 1)²) in unit directions (n, 3)."""
    count = coefficients.shape[1] // 3
    basis = sh_basis(direction, math.isqrt(count) - 1)
    return np.einsum("nk,nkc->nc", basis, coefficients.reshape(-1, count, 3))


def sh_basis(direction: Array, degree: int) -> Array:
    """Real spherical harmonics (…, (degree + 1)²) of unit directions (…, 3), with Condon-Shortley phase."""
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


def positive(x: Array) -> Array:
    """max(0, x) with slope 1 at 0."""
    return np.where(x.real < 0, 0, x)


def unit(v: Array) -> Array:
    """v / |v| by rows; (0, 0, 1) where |v|² is below NORM_FLOOR."""
    largest = np.abs(v.real).max(axis=1, keepdims=True)
    valid = largest > math.sqrt(c.NORM_FLOOR)
    v = np.where(valid, v / np.where(valid, largest, 1), np.array([0, 0, 1.0]))
    return v / np.sqrt(np.sum(v * v, axis=1, keepdims=True))
