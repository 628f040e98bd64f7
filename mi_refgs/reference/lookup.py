"""Shading of points, whose derivatives are complex steps: lookups in light and table as texels, weights."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c

Array = np.ndarray
DIELECTRIC_F0 = 0.04


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


def shade(
    light: Light,
    normal: Array,
    view: Array,
    materials: Array,
    own: Array | None,
    visibility: Array | None,
    indirect: Array | None,
    diffuse: str,
    taps: list[tuple[Array, Array, Array]],
    dominant: bool = False,
    multiscatter: bool = False,
) -> list[Array]:
    """Terms (n, 3) of points: diffuse, specular, indirect. As `shade.split_sum`.

    materials: (n, 5) albedo, metallic, roughness.
    """
    n, v = unit(normal), unit(view)
    albedo, metallic, roughness = materials[:, :3], materials[:, 3:4], materials[:, 4]
    n_v = np.sum(n * v, 1)
    f0 = DIELECTRIC_F0 * (1 - metallic) + albedo * metallic
    a, b = table(light.table, n_v, roughness)
    reflectance = f0 * a[:, None] + b[:, None]
    free = (np.ones(len(n)) if visibility is None else visibility)[:, None]
    direction = 2 * n_v[:, None] * n - v
    if dominant:  # [Lagarde and de Rousiers 2014, §4.9.3]
        smooth = 1 - roughness[:, None] ** 2
        direction = unit(n + smooth * (np.sqrt(smooth) + 1 - smooth) * (direction - n))
    texel, share = specular(light, direction, roughness)
    flat = light.flat()
    taps.append((texel, share, reflectance * free))
    reflected = reflectance * np.einsum("nk,nkc->nc", share, flat[texel])
    texel, share = bilinear(light, n, np.full(len(n), len(light.levels) - 1))
    arriving = np.einsum("nk,nkc->nc", share, flat[texel])
    if multiscatter:  # [Fdez-Agüera 2019]
        lost = (f0 + (1 - f0) / 21) * (1 - a - b)[:, None]
        further = reflectance * lost / (1 - lost)
        taps.append((texel, share, further * free))
        reflected, reflectance = reflected + further * arriving, reflectance + further
    if diffuse == "sh":
        assert own is not None
        scattered = (1 - metallic) * own
    else:
        factor = positive(1 - reflectance) * (1 - metallic) * albedo
        taps.append((texel, share, factor))
        scattered = factor * arriving
    blocked = np.zeros_like(scattered)
    if visibility is not None and indirect is not None:
        blocked = (1 - free) * indirect * reflectance
    return [scattered, free * reflected, blocked]


def table(table: Array, n_v: Array, roughness: Array) -> tuple[Array, Array]:
    n = len(table)
    x, y = clip(n_v, 0, 1) * n - 0.5, clip(roughness, 0, 1) * n - 0.5
    j, i = (np.clip(np.floor(q.real), 0, n - 2).astype(int) for q in (x, y))
    s, t = (x - j)[:, None], (y - i)[:, None]
    upper = (1 - s) * table[i, j] + s * table[i, j + 1]
    lower = (1 - s) * table[i + 1, j] + s * table[i + 1, j + 1]
    pair = (1 - t) * upper + t * lower
    return pair[:, 0], pair[:, 1]


def specular(light: Light, direction: Array, roughness: Array) -> tuple[Array, Array]:
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
    """Texels (n, 4) of the flat levels and their weights."""
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
    """Σ c_k Y_k (n, 3) of coefficients (n, 3 (degree + 1)²); Legendre functions by recursion over z."""
    degree = math.isqrt(coefficients.shape[1] // 3) - 1
    x, y, z = direction.T
    cos, sin = [np.ones_like(x)], [np.zeros_like(x)]  # r^m cos mφ, r^m sin mφ
    for _ in range(degree):
        cos, sin = [*cos, x * cos[-1] - y * sin[-1]], [*sin, x * sin[-1] + y * cos[-1]]
    p = {(0, 0): np.ones_like(z)}  # over r^m
    for m in range(1, degree + 1):
        p[m, m] = -(2 * m - 1) * p[m - 1, m - 1]
    for m in range(degree):
        p[m + 1, m] = (2 * m + 1) * z * p[m, m]
        for n in range(m + 2, degree + 1):
            p[n, m] = ((2 * n - 1) * z * p[n - 1, m] - (n + m - 1) * p[n - 2, m]) / (n - m)
    out = np.zeros((len(x), 3), coefficients.dtype)
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            k = abs(m)
            norm = math.sqrt((2 * n + 1) / (4 * math.pi) * math.factorial(n - k) / math.factorial(n + k))
            turn = 1 if m == 0 else math.sqrt(2) * (cos[k] if m > 0 else sin[k])
            i = 3 * (n * (n + 1) + m)
            out = out + (norm * p[n, k] * turn)[:, None] * coefficients[:, i : i + 3]
    return out


# ---------------- functions of complex steps ----------------


def positive(x: Array) -> Array:
    """max(0, x) with slope 1 at 0."""
    return np.where(x.real < 0, 0, x)


def clip(x: Array, low: float, high: float) -> Array:
    return np.where(x.real < low, low, np.where(x.real > high, high, x))


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
