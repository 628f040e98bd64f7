"""Our diffuse base in the terms of Mitsuba's `principled`.

Ours gets what the specular layer over it leaves; that of `principled` gets all, and is Disney's [Burley 2015,
"Extending the Disney BRDF to a BSDF", §4]: darker at grazing angles, brighter in retroreflection.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np

from mi_refgs.shade.brdf import split_sum
from mi_refgs.shade.split_sum import DIELECTRIC_F0

if TYPE_CHECKING:
    from mi_refgs.formats.textured import TexturedMesh

ROUGHNESSES = 33
"""Rows of the table, linear between them."""
NODES = 24
"""Nodes of the quadrature in each cosine and in azimuth: errors below 1e-4."""


def base_colour(made: TexturedMesh) -> np.ndarray:
    """The `base_color` (N, N, 3) with which `principled` reflects of constant light what ours does."""
    roughness, share = diffuse_share()
    dielectric = np.interp(made.roughness, roughness, share)
    return made.albedo * (made.metallic + (1 - made.metallic) * dielectric)[..., None].astype(np.float32)


@functools.lru_cache
def diffuse_share() -> tuple[np.ndarray, np.ndarray]:
    """Roughnesses, and for each what our base reflects of constant light over what Disney's does."""
    roughness = np.linspace(0, 1, ROUGHNESSES)
    node, weight = np.polynomial.legendre.leggauss(NODES)
    cosine, weight = (node + 1) / 2, weight / 2
    scale, bias = split_sum(
        mi.Float(np.tile(cosine, ROUGHNESSES).tolist()), mi.Float(np.repeat(roughness, NODES).tolist())
    )
    specular = np.array(DIELECTRIC_F0 * scale + bias).reshape(ROUGHNESSES, NODES)
    ours = 2 * ((1 - specular) * cosine * weight).sum(axis=1)

    azimuth = (np.arange(NODES) + 0.5) / NODES * np.pi
    into, out = cosine[:, None, None], cosine[None, :, None]
    sines = np.sqrt((1 - into**2) * (1 - out**2))
    squared = (1 + into * out + sines * np.cos(azimuth)) / 2  # cosine of the half angle
    f_in, f_out = (1 - into) ** 5, (1 - out) ** 5
    disney = []
    for r in roughness:
        retro = 2 * r * squared
        value = (1 - f_in / 2) * (1 - f_out / 2) + retro * (f_in + f_out + f_in * f_out * (retro - 1))
        mean = value.mean(axis=2) * cosine[:, None] * cosine * weight[:, None] * weight
        disney.append(4 * mean.sum())
    return roughness, ours / np.array(disney)
