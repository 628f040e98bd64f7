"""Densification by error, and pruning. [3DGS §5.2; Rota Bulò et al., Revising Densification, ECCV 2024, §3.1]

Splits run a few dozen times per fit, in NumPy.
"""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError
from mi_refgs.fitting.events.resets import ResetOpacity
from mi_refgs.fitting.exchange import exchange
from mi_refgs.fitting.state import TableEdit
from mi_refgs.fitting.train import Trainer
from mi_refgs.methods.extensions import Event, register_event
from mi_refgs.methods.fields import Window, at_least, between
from mi_refgs.splat.weights import BlendedView
from mi_refgs.surfels.attributes import logit, sigmoid
from mi_refgs.surfels.primitives.primitive import primitive_of
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

SPLIT_OFFSET, SPLIT_SCALE = 0.6, 0.72
"""Distance of the two children from the centre, and their scale, relative to the longest scale and along it:
with `split_opacity` their profile is the parent's but for 2 % of its energy."""
BACKGROUND_EXTENT = 0.5  # distances from the region's centre; larger surfels of the background are removed
WEIGHED_VIEWS, WEIGHED_SIZE = 48, 128  # views in which faint surfels are sought; their longer side, pixels
# A surfel of the background floats, if this share of its weight is before this part of the expected depth.
FLOATING, NEARER = 0.9, 0.7
NO_ROWS = np.empty(0, np.int64)


@register_event
@dataclass(frozen=True)
class Densify(Event[Trainer]):
    """Splits and prunes the surfels of the object and of the background."""

    name: ClassVar[str] = "densify"
    when: Window  # iterations at which it happens
    grow: float = field(default=0.25, metadata=at_least(0))  # fraction of the surfels split at most
    prune_opacity: float = field(default=0.05, metadata=between(0, 1))  # surfels of less are removed
    prune_extent: float = field(default=0.1, metadata=at_least(0))  # scene extents; larger ones are removed
    # Share of all blending weight; the surfels of the least weight per tile are removed.
    prune_weight: float = field(default=0.01, metadata=between(0, 1))

    def observes(self, trainer: Trainer) -> bool:
        return trainer.iteration + 1 <= self.when.until

    def due(self, trainer: Trainer) -> bool:
        return self.when.due(trainer.iteration)

    def apply(self, trainer: Trainer) -> None:
        """Grow where the error is, prune, and let surfels of an open scene change tables."""
        trainer.check()
        fit, extent = trainer.fit, trainer.data.scene_extent
        reset, rate = trainer.method.event.get(ResetOpacity.name), trainer.method.rates.of("opacity")
        grown = not isinstance(reset, ResetOpacity) or reset.grown(fit.iteration, self.prune_opacity, rate)
        opacity = self.prune_opacity if grown else 0.0
        weighed = self._weighed(trainer) if opacity else [(NO_ROWS, NO_ROWS)] * len(fit.tables)
        for table, (faint, floating) in zip(fit.tables, weighed, strict=True):
            largest: float | np.ndarray = self.prune_extent * extent
            if table.prefix:  # the background's surfels may grow with their distance
                region = trainer.region
                assert region is not None
                offset = table.surfels.raw["position"].numpy() - np.array(region.centre)
                largest = BACKGROUND_EXTENT * np.maximum(np.linalg.norm(offset, axis=1), region.radius)
            given: dict[str, Any] = {"largest": largest, "faint": faint, "gone": floating}
            given |= {"keep_one": bool(table.prefix), "grow": self.grow, "prune_opacity": opacity}
            table.apply(densify_and_prune(table.surfels, table.error_sum, table.max_count, **given))
        exchange(trainer.setup, fit)
        for table in fit.tables:
            table.clear()

    def _weighed(self, trainer: Trainer) -> list[tuple[np.ndarray, np.ndarray]]:
        """Rows of each table to remove: those with the least blending weight for the tiles they cost, and of
        the background also those that float before what the views show."""
        every = [table.surfels.detach() for table in trainer.fit.tables]
        position = np.concatenate([table.raw["position"].numpy() for table in every])
        own = trainer.surfels.count
        weight, cost, before = np.zeros((3, len(position)))
        for index in evenly_spread(len(trainer.data.views), WEIGHED_VIEWS):
            seen = trainer.posed(index)
            small = seen.camera().resized(min(WEIGHED_SIZE, max(seen.width, seen.height)))
            view = BlendedView.of(every, small, [0] * len(every))
            pixels, *depths = view.sums([1, view.maps.expected_depth][: len(every)])  # beside a background
            weight += pixels
            for deep in depths:
                before += pixels * (pixels * seen.depth_of(position) < NEARER * deep)
            cost += view.tiles
        floating = np.flatnonzero(before[own:] > FLOATING * weight[own:])
        tables = zip(np.split(weight, [own]), np.split(cost, [own]), (NO_ROWS, floating), strict=True)
        return [(least_weight(w, c, self.prune_weight), gone) for w, c, gone in tables][: len(every)]


def fill(trainer: Trainer) -> None:
    """Split the object's surfels with the largest error, as many as there is room for; prune none."""
    table = trainer.fit.tables[0]
    table.apply(densify_and_prune(table.surfels, table.error_sum, table.max_count, grow=1, prune_opacity=0))
    table.clear()


def split_opacity(opacity: np.ndarray) -> np.ndarray:
    """Opacity (N,) of the two children of surfels of this opacity: the least-squares fit, linear in it."""
    return opacity * (0.65 + 0.15 * opacity)


def densify_and_prune(
    surfels: Surfels,
    error: np.ndarray | Float,
    most: int,
    *,
    grow: float = 0.25,
    prune_opacity: float = 0.05,
    largest: float | np.ndarray = np.inf,
    faint: np.ndarray = NO_ROWS,
    gone: np.ndarray = NO_ROWS,
    keep_one: bool = False,
) -> TableEdit:
    """Split the surfels with the largest error; remove transparent and oversized ones, and faint ones.

    error: (N,), Σ w e² over the pixels of recent steps, or another score, such as the length of the
    position's gradient; none is split where it is 0. most: surfels that result at most. grow: fraction that
    is split at most. prune_opacity: surfels of less are removed, as are those larger than `largest`, scene
    units, one or (N,). faint: rows that make room for splits, the first ones first. gone: rows to remove.
    keep_one: the most opaque surfel stays. `ParameterTable.apply` takes the result. InputError if none stays.
    """
    error = np.array(error)
    raw = surfels.to_numpy()
    primitive = primitive_of(raw)
    opacity = sigmoid(raw["opacity"][:, 0])
    keep = (primitive.extent(raw)[1].max(axis=1) <= largest) & (opacity >= prune_opacity)
    keep[gone] = False
    if keep_one and not keep.any():
        keep[np.argmax(opacity)] = True
    if not keep.any():
        remedy = "lower it, raise prune_extent, or check that the images and their cameras belong together"
        what = "no surfel is opaque and small enough to stay"
        raise InputError(what, "event.densify.prune_opacity", remedy=remedy)

    # Early in a fit most surfels are faint, those that will be needed, too: they only make room.
    needed = math.ceil((1 + grow) * keep.sum()) - most
    keep[faint[keep[faint]][: max(needed, 0)]] = False

    # The surfels to split: those with the largest error, as many as there is room for.
    left = int(keep.sum())
    room = min(max(most - left, 0), math.ceil(grow * left))
    lasting = split_opacity(opacity) >= prune_opacity  # else the next event would remove the children
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
        primitive.turn(table, children, longest, side / deviations.max(axis=1))
        primitive.shrink(table, children, longest, SPLIT_SCALE)
        table["opacity"][children, 0] = logit(split_opacity(opacity[parent[children]]))
    return TableEdit(Surfels.from_numpy(table), parent.astype(np.uint32), fresh)


def least_weight(weight: np.ndarray, cost: np.ndarray, share: float) -> np.ndarray:
    """Rows of the surfels that together have at most this share of all weight (N,), in the order of weight
    per cost (N,), the tiles in whose lists they are."""
    order = np.argsort(weight / np.maximum(cost, 1), kind="stable")
    return order[np.cumsum(weight[order]) <= share * weight.sum()]
