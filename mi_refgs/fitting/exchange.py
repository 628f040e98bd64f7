"""Surfels that cross the border of the region of interest change tables.

The rule: a surfel of the object that is more than MARGIN radii outside of the region becomes one of the
surroundings, with its geometry and the harmonics that they have; one of the surroundings that is as far
inside becomes one of the object, whose other channels start as the method says. Neither has a history in its
new table. A table takes no more than its `max_count`, and none loses its last row.
"""

from __future__ import annotations

import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.fitting.refine import TableEdit
from mi_refgs.methods.method import Method
from mi_refgs.surfels.attributes import channel
from mi_refgs.surfels.table import Surfels

MARGIN = 0.02
"""Radii of the region by which a surfel has to cross its border: what lies on it stays."""

Raw = dict[str, np.ndarray]


def depth_outside(raw: Raw, region: Region) -> np.ndarray:
    """Distance (N,) of positions from the region's sphere in its radii, negative inside."""
    offset = np.linalg.norm(raw["position"] - np.array(region.centre), axis=1)
    found: np.ndarray = offset / region.radius - 1
    return found


def distances(surfels: Surfels, region: Region) -> np.ndarray:
    """Distance (N,) of surfels from the region's centre, at least its radius: with it sizes outside grow."""
    outside = depth_outside({"position": surfels.raw["position"].numpy()}, region)
    found: np.ndarray = region.radius * (1 + np.maximum(outside, 0))
    return found


def exchanged(
    inner: Surfels, outer: Surfels, method: Method, region: Region, rng: np.random.Generator
) -> list[TableEdit]:
    """Both tables after the exchange."""
    options = method.surroundings
    assert options is not None
    tables = [inner.to_numpy(), outer.to_numpy()]
    leaves = [depth_outside(tables[0], region) > MARGIN, depth_outside(tables[1], region) < -MARGIN]
    for i, limit in enumerate((options.max_count, method.surfels.max_count)):  # of where they go
        room = limit - len(leaves[1 - i])
        leaves[i] &= np.cumsum(leaves[i]) <= min(max(room, 0), len(leaves[i]) - 1)
    edits = []
    for own, other, gone, comes in zip(tables, tables[::-1], leaves, leaves[::-1], strict=True):
        stays = np.flatnonzero(~gone)
        moved = _converted({name: values[comes] for name, values in other.items()}, own, method, rng)
        table = {name: np.concatenate([values[stays], moved[name]]) for name, values in own.items()}
        parent = np.concatenate([stays, np.zeros(comes.sum(), int)]).astype(np.uint32)
        edits.append(TableEdit(Surfels.from_numpy(table), parent, np.arange(len(parent)) >= len(stays)))
    return edits


def _converted(rows: Raw, like: Raw, method: Method, rng: np.random.Generator) -> Raw:
    """Rows of the other table with the channels of a table `like` that."""
    made = {}
    for name, values in like.items():
        count, width = len(rows["position"]), values.shape[1]
        if name in rows:
            kept = rows[name][:, :width]
            made[name] = np.pad(kept, ((0, 0), (0, width - kept.shape[1])))
        else:
            made[name] = channel(name).start(count, width, rng, method.surfels.start(name))
    return {name: values.astype(np.float32) for name, values in made.items()}
