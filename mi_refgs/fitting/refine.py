"""Edits of a set of surfels: densification, pruning, resets, normal propagation.

Each is a function from surfels to new surfels, with the parent of each row if rows move. They run a few
hundred times per fit, not in every step, so they are plain NumPy on the raw attributes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import Propagation, Refine
from mi_refgs.surfels.attributes import attribute, logit, sigmoid
from mi_refgs.surfels.init import morton_order
from mi_refgs.surfels.primitives import primitive_of
from mi_refgs.surfels.table import Surfels

SPLIT_OFFSET, SPLIT_SCALE = 0.6, 0.72
"""Distance of a split surfel's two children from its centre, and their scale, both relative to its longest
scale and along that axis. With `split_opacity` their composited profile is the parent's but for 0.4 to 1.8 %
of its energy (opacity 0.3 to 0.99; least squares over scale and opacity at this distance). Smaller distances
fit better, but the children then differ too little."""
PRUNE_PATIENCE = 4.5
"""Factor of the fewest steps in which an opacity can grow back after a reset: 150 iterations as shipped.
Factor 2 (67 iterations) was too small on a diffuse scene, which lost every surfel."""
NO_ROWS = np.empty(0, np.int64)


def prune_wait(options: Refine, rate: float) -> float:
    """Iterations without pruning after a reset, in which opacities grow back, from their learning rate.

    Adam raises a logit by about its rate per step, so from reset_opacity to prune_opacity it takes at least
    logit(prune_opacity) - logit(reset_opacity) over the rate: 33 steps of 0.05 from 0.01 to 0.05. Presets do
    not scale the rate, and so do not scale these iterations.
    """
    lift = max(logit(options.prune_opacity) - logit(options.reset_opacity), 0.0)
    return PRUNE_PATIENCE * lift / rate if rate > 0 else math.inf


@dataclass(frozen=True)
class TableEdit:
    """New surfels; row i descends from row parent[i] of the old ones, and is `fresh` if it has no history."""

    surfels: Surfels
    parent: np.ndarray  # (M,) uint32
    fresh: np.ndarray  # (M,) bool

    def ordered(self) -> TableEdit:
        """Sort the rows in Morton order; densifying appends new ones."""
        order = morton_order(self.surfels.raw["position"].numpy())
        return TableEdit(self.surfels.gather(upload(order, mi.UInt32)), self.parent[order], self.fresh[order])


def split_opacity(opacity: np.ndarray) -> np.ndarray:
    """Opacity (N,) of the two children of surfels of this opacity: the least-squares fit, linear in it."""
    return opacity * (0.65 + 0.15 * opacity)


def densify_and_prune(
    surfels: Surfels,
    error: np.ndarray,  # (N,) squared error that the surfels are responsible for: Σ w e² over recent pixels
    faint: np.ndarray,  # rows that may be removed for others, the first ones first: `least_weight`
    largest: float | np.ndarray,  # scene units, one or (N,): larger surfels are removed
    options: Refine,
    most: int,
    keep_one: bool = False,
) -> TableEdit:
    """Split the surfels with the largest error; remove transparent and oversized ones, and faint ones.

    At most `most` surfels result; faint ones are removed as far as splits lack room. A surfel is split along
    its longest axis into two that together look like it, so that the image hardly changes. After an opacity
    reset, neither faint nor transparent ones are removed for `prune_wait` iterations: `faint` is empty and
    prune_opacity 0. `keep_one`: the most opaque surfel stays in any case. Raises InputError if no surfel
    would be left.

    Growth by error: Rota Bulò et al., Revising Densification in Gaussian Splatting, ECCV 2024, §3.1.
    """
    raw = surfels.to_numpy()
    primitive = primitive_of(raw)
    opacity = sigmoid(raw["opacity"][:, 0])
    size = primitive.extent(raw)[1].max(axis=1)
    keep = (size <= largest) & (opacity >= options.prune_opacity)
    if keep_one and not keep.any():
        keep[np.argmax(opacity)] = True
    if not keep.any():
        raise InputError(
            "refine.prune_opacity: no surfel is opaque and small enough to stay; lower it, raise "
            "refine.prune_extent, or check that the images and their cameras belong together"
        )

    # Early in a fit most surfels are faint, those that will be needed, too: they only make room.
    needed = math.ceil((1 + options.grow) * keep.sum()) - most
    keep[faint[keep[faint]][: max(needed, 0)]] = False

    # The surfels to split: those with the largest error, as many as there is room for.
    left = int(keep.sum())
    room = min(max(most - left, 0), math.ceil(options.grow * left))
    lasting = split_opacity(opacity) >= options.prune_opacity  # else the next event would remove the children
    candidates = np.flatnonzero(keep & lasting & (error > 0))
    split = np.sort(candidates[np.argsort(-error[candidates], kind="stable")[:room]])
    keep[split] = False

    # Two children of each, in place of the parent.
    kept = np.flatnonzero(keep)
    parent = np.concatenate([kept, split, split])
    fresh = np.arange(len(parent)) >= len(kept)
    table = {name: values[parent].copy() for name, values in raw.items()}
    if len(split):
        children = slice(len(kept), len(parent))
        axes, deviations = primitive.extent({name: values[children] for name, values in table.items()})
        longest = deviations.argmax(axis=1)
        along = np.take_along_axis(axes, longest[:, None, None], axis=1)[:, 0]
        side = np.repeat([SPLIT_OFFSET, -SPLIT_OFFSET], len(split)) * deviations.max(axis=1)
        table["position"][children] += (side[:, None] * along).astype(np.float32)
        primitive.shrink(table, children, longest, SPLIT_SCALE)
        table["opacity"][children, 0] = logit(split_opacity(opacity[parent[children]]))
    return TableEdit(Surfels.from_numpy(table), parent.astype(np.uint32), fresh)


def least_weight(weight: np.ndarray, cost: np.ndarray, share: float) -> np.ndarray:
    """Rows of the surfels that together have at most this share of all weight, least weight per cost first.

    `weight`: blending weights (N,); `cost`: tiles (N,) in whose lists they are.
    """
    order = np.argsort(weight / np.maximum(cost, 1), kind="stable")
    return order[np.cumsum(weight[order]) <= share * weight.sum()]


def reset_opacity(surfels: Surfels, options: Refine, floors: Mapping[str, float]) -> Surfels:
    """Lower opacities to at most reset_opacity, and raise the attributes in `floors` to at least their value.

    Surfels that the images require grow back; others are pruned. [3DGS §5.2; 3DGS-DR for the metallic]
    """
    raw = surfels.to_numpy()
    raw["opacity"] = np.minimum(raw["opacity"], np.float32(logit(options.reset_opacity)))
    for name, floor in floors.items():
        raw[name] = np.maximum(raw[name], np.float32(logit(floor)))
    return Surfels.from_numpy(raw)


def propagate_normals(surfels: Surfels, options: Propagation, rng: np.random.Generator) -> Surfels:
    """Make all surfels opaque, and enlarge the reflective ones. [3DGS-DR §3.3; Ref-Gaussian §3.4]

    Enlarged opaque surfels cover their neighbours, whose reflections then follow the normals that already
    explain them. Reflective means metallic, and not rough, if there is a limit: a rough metal has no sharp
    reflection. Noise on the colour of the others keeps it from explaining reflections.
    """
    raw = surfels.to_numpy()
    raw["opacity"] = np.maximum(raw["opacity"], np.float32(logit(options.opacity)))
    metallic = sigmoid(raw["metallic"][:, 0])
    reflective = metallic >= options.metallic
    if options.roughness is not None and "roughness" in raw:
        reflective &= sigmoid(raw["roughness"][:, 0]) <= options.roughness
    primitive_of(raw).resize(raw, reflective, options.scale)
    if options.noise and "radiance_sh" in raw:
        dull = np.flatnonzero(metallic <= options.noise_metallic)
        noise = rng.uniform(-options.noise, options.noise, (len(dull), 3))
        raw["radiance_sh"][dull, :3] += noise.astype(np.float32)
    return Surfels.from_numpy(raw)


def restart(surfels: Surfels, starts: Mapping[str, float], rng: np.random.Generator) -> Surfels:
    """Reset attributes to the initial values `starts`. [Ref-Gaussian, implementation details]"""
    raw = surfels.to_numpy()
    for name, value in starts.items():
        count, width = raw[name].shape
        raw[name] = attribute(name).start(count, width, rng, value)
    return Surfels.from_numpy(raw)
