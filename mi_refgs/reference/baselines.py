"""The reflectance models of the baselines in NumPy float64, point by point: directions and colours are (3,).

Lights are lookups that the caller gives, such as `shade.bilinear` of a map.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from mi_refgs.reference.shade import sh_basis

Array = np.ndarray
Lookup = Callable[[Array], Array]


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)


def mirror(radiance: Lookup, *, normal: Array, view: Array, own: Array, metallic: float) -> Array:
    """Terms (2, 3) of 3DGS-DR: the fitted radiance `own`, and the light in the mirror direction."""
    n, v = _unit(normal), _unit(view)
    return np.stack([(1 - metallic) * own, metallic * radiance(2 * (n @ v) * n - v)])


def gaussian_shader(
    irradiance: Lookup,
    specular: Callable[[Array, float], Array],
    split_sum: Callable[[float, float], Array],
    *,
    normal: Array,
    view: Array,
    own: Array,
    tint: Array,
    roughness: float,
) -> Array:
    """Terms (2, 3) of GaussianShader: colour and diffuse light, and tinted specular light."""
    n, v = _unit(normal), _unit(view)
    a, b = split_sum(float(n @ v), roughness)
    diffuse = own + irradiance(n) * (1 - tint)
    return np.stack([diffuse, specular(2 * (n @ v) * n - v, roughness) * (tint * a + b)])


def hemisphere(count: int, normal: Array) -> Array:
    """The directions (count, 3) of a Fibonacci hemisphere about a unit normal, at least 10° high.

    In the frame of Duff et al. 2017, "Building an Orthonormal Basis, Revisited".
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


def monte_carlo(
    radiance: Lookup,
    directions: Array,
    *,
    normal: Array,
    view: Array,
    albedo: Array,
    roughness: float,
    free: Sequence[bool] | None = None,
    incident: Array | None = None,
) -> Array:
    """Terms (3, 3) of R3DG: scattered and glossy light of the environment, and all light of surfaces nearby.

    `directions` (J, 3) stay where they are if the normal turns; `incident` (C, 3) harmonics.
    """
    n, v = _unit(normal), _unit(view)
    base, r = 0.77 * albedo + 0.03, 0.9 * roughness + 0.09
    out = np.zeros((3, 3))
    for j, w in enumerate(directions):
        h = _unit(v + w)
        n_l, n_v, n_h, v_h = float(n @ w), float(n @ v), float(n @ h), float(v @ h)
        f_s = 0.0
        if n_v > 0:
            d = r**4 / (math.pi * (n_h**2 * (r**4 - 1) + 1) ** 2)
            f = 0.04 + 0.96 * 2 ** ((-5.55473 * v_h - 6.98316) * v_h)
            k = (r + 1) ** 2 / 8
            g = n_v / (n_v * (1 - k) + k) * n_l / (n_l * (1 - k) + k)
            f_s = d * f * g / (4 * n_l * n_v)
        weight = 2 * math.pi * max(n_l, 0) / len(directions)
        light = radiance(w) * (1.0 if free is None or free[j] else 0.0)
        out[0] += weight * base / math.pi * light
        out[1] += weight * f_s * light
        if incident is not None:
            local = np.maximum(sh_basis(w, math.isqrt(len(incident)) - 1) @ incident, 0)
            out[2] += weight * (base / math.pi + f_s) * local
    return out
