"""The split-sum table: reflectance F0·A + B of a GGX surface under constant light, over (N·V, roughness).

α = roughness², height-correlated Smith shadowing, Schlick's Fresnel. [Karis 2013, "Real Shading in Unreal
Engine 4"; Heitz 2014, "Understanding the Masking-Shadowing Function", eq. 99]"""

import functools
import os
from contextlib import suppress
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import replace_file
from mi_refgs.kernels.device import aligned
from mi_refgs.types import Float

RESOLUTION = 256  # texels per axis, values at their centres: bilinear lookups are then within 3e-4
RADIAL_NODES, AZIMUTH_NODES = 48, 32  # of half vectors: errors below 4e-4 at the smallest N·V, else 1e-4
HORIZON = 1e-7  # smallest N·L whose 1/(N·L)² still fits float32; below it shadowing leaves nothing
CACHE_NAME = "split_sum_256_v1.npy"  # raise the version when a number of the table changes


def compute_table() -> np.ndarray:
    """Split-sum table (256, 256, 2) float32, [roughness row, N·V column, (A, B)], by fixed quadrature."""
    x, weight = np.polynomial.legendre.leggauss(RADIAL_NODES)
    # ξ = 1 - s² draws half vectors from D cosθ; the square gathers nodes at the grazing ones.
    s, weight = 0.5 * (1 - x), 0.5 * weight * (1 - x)
    φ = (np.arange(AZIMUTH_NODES) + 0.5) * (np.pi / AZIMUTH_NODES)
    centre = (np.arange(RESOLUTION) + 0.5) / RESOLUTION
    n_v = centre.astype(np.float32)[:, None, None]
    across = np.sqrt(1 - n_v * n_v) * np.cos(φ).astype(np.float32)
    tan2_v = 1 / (n_v * n_v) - 1
    table = np.empty((RESOLUTION, RESOLUTION, 2))
    for row, roughness in enumerate(centre):
        α2 = np.float32(roughness**4)
        n_h = np.sqrt(s * s / (s * s + α2 * (1 - s * s)))
        sin_h = np.sqrt(1 - s * s) * roughness**2 / np.sqrt(s * s + α2 * (1 - s * s))
        share = (weight / n_h).astype(np.float32)[:, None]
        n_h, sin_h = n_h.astype(np.float32)[:, None], sin_h.astype(np.float32)[:, None]
        v_h = n_v * n_h + across * sin_h
        n_l = 2 * v_h * n_h - n_v
        lit = n_l > HORIZON
        n_l = np.maximum(n_l, np.float32(HORIZON))
        tan2_l = np.maximum(1 / (n_l * n_l) - 1, 0)
        smith = 2 / (np.sqrt(1 + α2 * tan2_v) + np.sqrt(1 + α2 * tan2_l))  # 1 / (1 + Λ(V) + Λ(L))
        reflected = np.where(lit, smith * v_h * share, 0)  # f cosθ_l / (pdf F), times N·V
        schlick = (1 - v_h) ** 5
        b = (reflected * schlick).sum((1, 2), dtype=np.float64)
        table[row, :, 0] = reflected.sum((1, 2), dtype=np.float64) - b
        table[row, :, 1] = b
    return (table / (AZIMUTH_NODES * centre[None, :, None])).astype(np.float32)


@functools.lru_cache(maxsize=1)
def table() -> np.ndarray:
    """The table of `compute_table`, kept in $XDG_CACHE_HOME or ~/.cache if that can be read or written."""
    path = None
    with suppress(OSError, ValueError, RuntimeError, EOFError):
        cache = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
        path = Path(cache) / "mi_refgs" / CACHE_NAME
        cached = np.load(path, allow_pickle=False)
        kind = cached.shape, cached.dtype
        if kind == ((RESOLUTION, RESOLUTION, 2), np.float32) and np.isfinite(cached).all():
            return cached
    computed = compute_table()
    with suppress(OSError, InputError):
        if path is not None:
            replace_file(path, lambda temporary: np.save(temporary, computed))
    return computed


@functools.lru_cache(maxsize=4)
def device_table(variant: str) -> Any:
    """The table as evaluated mi.Float of the variant that is set."""
    # In NumPy's memory: the first gather may be in a recorded loop, where `upload` cannot run its kernel.
    return mi.Float(aligned(table()))


def split_sum(n_dot_v: Float, roughness: Float) -> tuple[Float, Float]:
    """Scale A and bias B of the reflectance F0·A + B of a GGX surface under constant light: differentiable,
    bilinear in the table, extrapolated over the outer half texels, both arguments clamped to [0, 1]."""
    data = device_table(mi.variant())

    def place(x: Any) -> tuple[Any, Any]:
        x = dr.clip(x, 0, 1) * RESOLUTION - 0.5
        # Bounded as integers: a NaN passes bounds of floats.
        first = dr.minimum(mi.UInt32(dr.maximum(dr.detach(x), 0)), RESOLUTION - 2)
        return first, x - mi.Float(first)

    column, u = place(n_dot_v)
    row, v = place(roughness)
    texel = row * RESOLUTION + column
    t00, t01, t10, t11 = (dr.gather(mi.Vector2f, data, texel + k) for k in (0, 1, RESOLUTION, RESOLUTION + 1))
    across, down = t01 - t00, t10 - t00
    pair = t00 + u * across + v * dr.fma(u, (t11 - t10) - across, down)
    return pair.x, pair.y
