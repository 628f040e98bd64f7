"""Reflectance models in float64, many points at once; derivatives by complex steps.

A model is a function of points and a light to its three terms of radiance. `taps` collects its lookups in the
light: texels, weights, and the factor that their sum is multiplied by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.shade import clip, sh_basis, table_lookup

Array = np.ndarray
Taps = list[tuple[Array, Array, Array]]


DIELECTRIC_F0 = 0.04
MATERIALS = ("albedo", "metallic", "roughness", "tint")


@dataclass(frozen=True)
class Light:
    """Prefiltered levels, the map itself first, and the roughness of the others; the split-sum table."""

    levels: list[Array]  # (h, 2h, 3) each
    roughness: tuple[float, ...]
    table: Array  # (n, n, 2): [roughness, n·v]
    turn: Array | None = None  # (3, 3): from world directions to the map's

    def flat(self) -> Array:
        """All texels (T, 3), level after level."""
        return np.concatenate([level.reshape(-1, 3) for level in self.levels])

    def split(self, flat: Array) -> list[Array]:
        """Inverse of `flat`."""
        ends = np.cumsum([level.size // 3 for level in self.levels])[:-1]
        return [x.reshape(y.shape) for x, y in zip(np.split(flat, ends), self.levels, strict=True)]


@dataclass(frozen=True)
class Options:
    """Choices of a shading beside its model."""

    diffuse: str = "sh"
    dominant: bool = False
    multiscatter: bool = False
    directions: int = 24  # of `monte_carlo`
    free: Array | None = None  # (n, directions): whether light arrives along them
    detached_normal: Array | None = None  # (n, 3): about which these are taken, where it is not the point's


@dataclass(frozen=True)
class Points:
    """Points to shade; arrays (n, …)."""

    normal: Array
    view: Array
    values: dict[str, Array]  # by name, such as albedo (n, 3) and metallic (n, 1)
    visibility: Array | None = None  # (n,)


Model = Callable[[Points, Light | None, Options, Taps], list[Array]]


def split_sum(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of `shade.split_sum`: GGX by a prefiltered light and a table, diffuse by SH or irradiance."""
    assert light is not None
    n, v, values = unit(points.normal), unit(points.view), points.values
    albedo, metallic, roughness = values["albedo"], values["metallic"], values["roughness"][:, 0]
    n_v = np.sum(n * v, 1)
    f0 = DIELECTRIC_F0 * (1 - metallic) + albedo * metallic
    a, b = table_lookup(light.table, n_v, roughness).T
    reflectance = f0 * a[:, None] + b[:, None]
    free = (np.ones(len(n)) if points.visibility is None else points.visibility)[:, None]
    direction = 2 * n_v[:, None] * n - v
    if options.dominant:  # [Lagarde and de Rousiers 2014, §4.9.3]
        smooth = 1 - roughness[:, None] ** 2
        direction = unit(n + smooth * (np.sqrt(smooth) + 1 - smooth) * (direction - n))
    texel, share = specular(light, direction, roughness)
    flat = light.flat()
    taps.append((texel, share, reflectance * free))
    reflected = reflectance * np.einsum("nk,nkc->nc", share, flat[texel])
    texel, share = bilinear(light, n, np.full(len(n), len(light.levels) - 1))
    irradiance = np.einsum("nk,nkc->nc", share, flat[texel])
    if options.multiscatter:  # [Fdez-Agüera 2019]
        lost = (f0 + (1 - f0) / 21) * (1 - a - b)[:, None]
        further = reflectance * lost / (1 - lost)
        taps.append((texel, share, further * free))
        reflected, reflectance = reflected + further * irradiance, reflectance + further
    if options.diffuse == "sh":
        scattered = (1 - metallic) * values["radiance"]
    else:
        factor = positive(1 - reflectance) * (1 - metallic) * albedo
        taps.append((texel, share, factor))
        scattered = factor * irradiance
    blocked = np.zeros_like(scattered)
    if points.visibility is not None and "indirect" in values:
        blocked = (1 - free) * values["indirect"] * reflectance
    return [scattered, free * reflected, blocked]


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
    reflected = _looked_up(light, 2 * np.sum(n * v, 1, keepdims=True) * n - v, 0, share, taps)
    return _terms((1 - share) * points.values["radiance"], reflected)


def gaussian_shader(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of GaussianShader: SH colour, diffuse light, and tinted specular light."""
    assert light is not None
    n, v, values = unit(points.normal), unit(points.view), points.values
    tint, roughness = values["tint"], values["roughness"][:, 0]
    cosine = np.sum(n * v, 1)
    scale, bias = table_lookup(light.table, cosine, roughness).T
    around = _looked_up(light, n, len(light.levels) - 1, 1 - tint, taps)
    texel, weight = specular(light, 2 * cosine[:, None] * n - v, roughness)
    factor = tint * scale[:, None] + bias[:, None]
    taps.append((texel, weight, factor))
    reflected = np.einsum("nk,nkc->nc", weight, light.flat()[texel])
    return _terms(values["radiance"] + around, factor * reflected)


def monte_carlo(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """Model of R3DG: diffuse and specular light of the environment, and all light of surfaces nearby.

    The normal has no derivative.
    """
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
        for term, share in enumerate((base / math.pi, f_s)):
            found[term] = found[term] + _looked_up(light, w, 0, free * weight * share, taps)
        if incident is not None:
            found[2] = found[2] + weight * (base / math.pi + f_s) * positive(harmonics(incident, w))
    return found


def hemisphere(count: int, normal: Array) -> Array:
    """Directions (count, 3) of a Fibonacci hemisphere about a unit normal (3,), at least 10° high.

    The frame is that of Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
    """
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
    "split_sum": split_sum,
    "radiance": radiance,
    "mirror": mirror,
    "gaussian_shader": gaussian_shader,
    "monte_carlo": monte_carlo,
    "displayed": displayed,
}


def _looked_up(light: Light, direction: Array, level: int, factor: Array, taps: Taps) -> Array:
    """`factor` (n, …) times the light (n, 3) in unit directions, of one level."""
    texel, weight = bilinear(light, direction, np.full(len(direction), level))
    taps.append((texel, weight, np.broadcast_to(factor, (len(direction), 3))))
    return factor * np.einsum("nk,nkc->nc", weight, light.flat()[texel])


def _terms(*known: Array) -> list[Array]:
    """The three terms, zero where there is none."""
    return [*known, *(np.zeros_like(known[0]) for _ in range(3 - len(known)))]


def specular(light: Light, direction: Array, roughness: Array) -> tuple[Array, Array]:
    """Texels (n, 8) and weights of a lookup between the two levels next to the roughness (n,)."""
    first, r = light.roughness[0], roughness
    sharp = r.real <= first
    level = np.where(sharp, (np.where(sharp, r, first) / first) ** 4, 1.0)
    inverse = 1 / np.where(sharp, first, r)
    for a, b in zip(light.roughness, light.roughness[1:], strict=False):
        level = level + clip((inverse - 1 / a) / (1 / b - 1 / a), 0, 1)
    lower = np.clip(level.real.astype(int), 0, len(light.levels) - 2)
    t = (level - lower)[:, None]
    one, two = (bilinear(light, direction, lower + k) for k in range(2))
    return np.concatenate([one[0], two[0]], 1), np.concatenate([(1 - t) * one[1], t * two[1]], 1)


def bilinear(light: Light, direction: Array, level: Array) -> tuple[Array, Array]:
    """Texels (n, 4) of the flat levels, and their weights, in unit directions (n, 3) of levels (n,)."""
    heights = np.array([len(x) for x in light.levels])
    firsts = np.concatenate([[0], np.cumsum(2 * heights**2)[:-1]])
    h = heights[level]
    w, first = 2 * h, firsts[level]
    x, y, z = direction.T if light.turn is None else light.turn @ direction.T
    pole = (x.real == 0) & (z.real == 0)
    sin = np.where(pole, 0, np.sqrt(np.where(pole, 1, x * x + z * z)))
    turn = atan2(np.where(pole, 0, x), np.where(pole, -1, -z)) / (2 * math.pi)
    u = np.where(turn.real < 0, turn + 1, turn) * w - 0.5
    v = atan2(sin, y) / math.pi * (h - 1)
    j = np.floor(u.real).astype(int)
    i = np.clip(np.floor(v.real).astype(int), 0, h - 2)
    s, t = u - j, v - i
    texel = [first + (i + a) * w + (j + b) % w for a in (0, 1) for b in (0, 1)]
    share = [(t if a else 1 - t) * (s if b else 1 - s) for a in (0, 1) for b in (0, 1)]
    return np.stack(texel, 1), np.stack(share, 1)


def harmonics(coefficients: Array, direction: Array) -> Array:
    """Σ c_k Y_k (n, 3) of coefficients (n, 3 (degree + 1)²) in unit directions (n, 3)."""
    count = coefficients.shape[1] // 3
    basis = sh_basis(direction, math.isqrt(count) - 1)
    return np.einsum("nk,nkc->nc", basis, coefficients.reshape(-1, count, 3))


# ---------------- functions of complex steps ----------------


def positive(x: Array) -> Array:
    """max(0, x) with slope 1 at 0."""
    return np.where(x.real < 0, 0, x)


def atan2(y: Array, x: Array) -> Array:
    value = np.arctan2(y.real, x.real)
    if not (np.iscomplexobj(y) or np.iscomplexobj(x)):
        return value
    squared = x.real**2 + y.real**2
    slope = (x.real * np.imag(y) - y.real * np.imag(x)) / np.where(squared > 0, squared, 1)
    return value + 1j * slope


def unit(v: Array) -> Array:
    """v / |v| by rows; (0, 0, 1) where |v|² is below NORM_FLOOR."""
    largest = np.abs(v.real).max(axis=1, keepdims=True)
    valid = largest > math.sqrt(c.NORM_FLOOR)
    v = np.where(valid, v / np.where(valid, largest, 1), np.array([0, 0, 1.0]))
    return v / np.sqrt(np.sum(v * v, axis=1, keepdims=True))
