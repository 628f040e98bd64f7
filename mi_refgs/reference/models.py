"""Reflectance models in float64, many points at once; derivatives by complex steps.

A model is a function of points and a light to its three terms of radiance. `taps` collects its lookups in the
light: texels, weights, and what their sum is multiplied by.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mi_refgs.reference import lookup
from mi_refgs.reference.baselines import hemisphere
from mi_refgs.reference.lookup import Light, harmonics, positive, unit

Array = np.ndarray
Taps = list[tuple[Array, Array, Array]]
MATERIALS = ("albedo", "metallic", "roughness", "tint")


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
    """See `shade.split_sum`."""
    assert light is not None
    values = points.values
    materials = np.concatenate([values[name] for name in MATERIALS[:3]], axis=1)
    own = values["radiance"] if options.diffuse == "sh" else None
    return lookup.shade(
        light, points.normal, points.view, materials, own, points.visibility, values.get("indirect"),
        options.diffuse, taps, options.dominant, options.multiscatter,
    )  # fmt: skip


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
    """See `baselines.mirror`."""
    assert light is not None
    n, v = unit(points.normal), unit(points.view)
    share = points.values["metallic"]
    reflected = _looked_up(light, 2 * np.sum(n * v, 1, keepdims=True) * n - v, 0, share, taps)
    return _terms((1 - share) * points.values["radiance"], reflected)


def gaussian_shader(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """See `baselines.gaussian_shader`."""
    assert light is not None
    n, v, values = unit(points.normal), unit(points.view), points.values
    tint, roughness = values["tint"], values["roughness"][:, 0]
    cosine = np.sum(n * v, 1)
    scale, bias = lookup.table(light.table, cosine, roughness)
    around = _looked_up(light, n, len(light.levels) - 1, 1 - tint, taps)
    texel, weight = lookup.specular(light, 2 * cosine[:, None] * n - v, roughness)
    factor = tint * scale[:, None] + bias[:, None]
    taps.append((texel, weight, factor))
    reflected = np.einsum("nk,nkc->nc", weight, light.flat()[texel])
    return _terms(values["radiance"] + around, factor * reflected)


def monte_carlo(points: Points, light: Light | None, options: Options, taps: Taps) -> list[Array]:
    """See `baselines.monte_carlo`; the normal has no derivative."""
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
    texel, weight = lookup.bilinear(light, direction, np.full(len(direction), level))
    taps.append((texel, weight, np.broadcast_to(factor, (len(direction), 3))))
    return factor * np.einsum("nk,nkc->nc", weight, light.flat()[texel])


def _terms(*known: Array) -> list[Array]:
    """The three terms, zero where there is none."""
    return [*known, *(np.zeros_like(known[0]) for _ in range(3 - len(known)))]
