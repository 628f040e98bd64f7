"""Relocation: idle surfels move onto those that are seen, and what is nearly transparent wanders.

[3DGS-MCMC, Kheradmand et al., NeurIPS 2024]
Letters: o opacity, s scale, N surfels at one place, η learning rate of positions, Σ covariance.
"""

from __future__ import annotations

import math
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.fitting.refine import TableEdit
from mi_refgs.methods.method import Relocation
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.primitives import primitive_of, widths_of
from mi_refgs.surfels.table import Surfels

MOST_COPIES = 51
"""Surfels at one place that the correction tells apart, at most; their opacities hardly change beyond. [code
of 3DGS-MCMC]"""
SHARPNESS = 100.0
"""Slope of the noise over opacity: what is a few hundredths more opaque than the idle hardly moves. [§4.2]"""
OPACITY_RANGE = (0.005, 1 - 1e-4)
"""Opacities after a correction: none is idle at once, and logits stay moderate."""


def shared(opacity: np.ndarray, number: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What `number` surfels at one place have each, to look like the one of this opacity (N,).

    Returns their opacity, 1 - (1 - o)^(1/N), and the factor of their scales, with which the integral along a
    line through the centre stays [eq. 9]:
        o / Σ_{k<N} (-1)^k C(N, k+1) o'^{k+1} / √(k+1),  the sum over i of eq. 9 done.
    """
    number = np.clip(number, 1, MOST_COPIES)
    new = 1 - (1 - np.minimum(opacity, OPACITY_RANGE[1])) ** (1 / number)
    total = np.zeros_like(new)
    for k in range(int(number.max(initial=1))):
        binomial = np.array([math.comb(n, k + 1) for n in range(MOST_COPIES + 1)], dtype=float)
        total += (-1) ** k * binomial[number] * new ** (k + 1) / math.sqrt(k + 1)
    return new, opacity / np.maximum(total, np.finfo(float).tiny)


def relocate(surfels: Surfels, options: Relocation, max_count: int, rng: np.random.Generator) -> TableEdit:
    """Put each idle surfel onto a seen one, drawn by opacity, and add copies up to `grow` and `max_count`.

    All that then share a place are corrected so that the picture hardly changes. Moved and added rows, and
    those onto which they moved, are `fresh`: their history is of another surfel.
    """
    raw = surfels.to_numpy()
    opacity = sigmoid(raw["opacity"][:, 0].astype(np.float64))
    idle = opacity <= options.opacity
    count = len(opacity)
    added = min(int(options.grow * count), max(max_count - count, 0))
    moved = np.flatnonzero(idle)
    if idle.all() or not len(moved) + added:
        return TableEdit(surfels, np.arange(count, dtype=np.uint32), np.zeros(count, bool))
    weight = np.where(idle, 0, opacity)
    parent = np.concatenate([np.arange(count), np.zeros(added, int)])
    takes = np.concatenate([moved, count + np.arange(added)])
    parent[takes] = rng.choice(count, len(takes), p=weight / weight.sum())
    number = np.bincount(parent, minlength=count)
    new, factor = shared(opacity, number)

    table = {name: values[parent].copy() for name, values in raw.items()}
    changed = number[parent] > 1
    table["opacity"][changed, 0] = logit(np.clip(new[parent[changed]], *OPACITY_RANGE))
    for name in primitive_of(widths_of(raw)).sizes:
        table[name][changed] += np.log(factor[parent[changed], None]).astype(np.float32)
    return TableEdit(Surfels.from_numpy(table), parent.astype(np.uint32), changed)


def wander(
    surfels: Surfels, rate: float, extent: float, options: Relocation, iteration: int, seed: int
) -> Any:
    """Positions (mi.TensorXf) after a random step of η λ Σ ε / (1 + exp(SHARPNESS (o - opacity))). [eq. 7, 8]

    ε are normal deviates that follow from seed and iteration. `rate` is η, and 1/λ has the unit of Σ; lengths
    in both are in extents. A second call compiles nothing.
    """
    with dr.suspend_grad():
        draw = mi.PCG32(
            size=surfels.count, initstate=dr.opaque(mi.UInt64, seed), initseq=dr.opaque(mi.UInt64, iteration)
        )
        awake = dr.exp(SHARPNESS * (surfels.opacity() - options.opacity))
        scale = dr.opaque(mi.Float, rate * options.noise / extent) / (1 + awake)
        moved = surfels.position()
        for axis, deviation in zip(surfels.frame(), surfels.scale(), strict=False):  # a surfel has two
            ε = mi.warp.square_to_std_normal(mi.Point2f(draw.next_float32(), draw.next_float32())).x
            moved += axis * (dr.square(deviation) * ε * scale)
        return mi.TensorXf(dr.ravel(moved), shape=(surfels.count, 3))
