"""Surfels that cross the border of the region of interest change tables.

One of the object whose centre is more than MARGIN radii outside becomes one of the background, with its
geometry and SH; one of the background that is inside, and through no plane, becomes one of the object, whose
other attributes start as the method says. Neither has a history. A table keeps one surfel at least, and may
exceed what its method allows. Once the region follows the object, small parts apart from it are background.
"""

import numpy as np

from mi_refgs.data.object_region import linked
from mi_refgs.data.region import Region
from mi_refgs.fitting.initial import converted
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState, TableEdit
from mi_refgs.methods.method import Method
from mi_refgs.surfels.primitives.primitive import primitive_of
from mi_refgs.surfels.table import Surfels

REACH = 1.0  # deviations to which a surfel extends: one through the plane below the object stays the table's
MARGIN = 0.02  # distance beyond the border of the region, in radii, from which a surfel leaves the object
LINK = 6.0  # distance of neighbours in a part, in radii over the root of their number; 3 sizes on *fox*
FEWEST, MOST = 20, 0.05  # surfels of a part that is background, and share; fewer may be inside of the object


def exchange(setup: FitSetup, fit: FitState) -> None:
    """Let the surfels beyond the border of the region change tables; of an open scene only."""
    region = fit.region or setup.data.region
    if not setup.open_scene or region is None:
        return
    inner, outer = (table.surfels for table in fit.tables)
    rng, whole = setup.rng(fit.iteration, "densify"), fit.region is None
    edits = exchanged(inner, outer, setup.method, region, rng, whole)
    for table, edit in zip(fit.tables, edits, strict=True):
        table.apply(edit)


def exchanged(
    inner: Surfels, outer: Surfels, method: Method, region: Region, rng: np.random.Generator, whole: bool
) -> list[TableEdit]:
    """Both tables afterwards, with axes and sizes as far as possible; small parts stay in the `whole` one."""
    tables = [inner.to_numpy(), outer.to_numpy()]
    own_depth = depth_outside(tables[0]["position"], region)
    other_depth = depth_outside(tables[1]["position"], region, reach_of(tables[1], region))
    leaves = [own_depth > MARGIN, other_depth < 0]
    if not whole:
        inside = np.concatenate([~leaves[0], leaves[1]])
        position = np.concatenate([table["position"] for table in tables])[inside]
        part = linked(position, LINK * region.radius / max(len(position), 1) ** 0.5)
        count = np.bincount(part)
        inside[inside] = ((count >= FEWEST) & (count < MOST * len(part)))[part]
        leaves = [gone ^ x for gone, x in zip(leaves, np.split(inside, [inner.count]), strict=True)]
    for gone in leaves:  # one surfel stays
        gone &= np.cumsum(gone) < len(gone)
    edits = []
    for own, other, gone, comes in zip(tables, tables[::-1], leaves, leaves[::-1], strict=True):
        stays = np.flatnonzero(~gone)
        widths = {name: values.shape[1] for name, values in own.items()}
        arrives = {name: values[comes] for name, values in other.items()}
        before, after = primitive_of(other), primitive_of(own)
        if before is not after and comes.any():
            arrives |= after.like(*before.extent(arrives))
        moved = converted(arrives, widths, method, rng)
        table = {name: np.concatenate([values[stays], moved[name]]) for name, values in own.items()}
        parent = np.concatenate([stays, np.zeros(comes.sum(), int)]).astype(np.uint32)
        edits.append(TableEdit(Surfels.from_numpy(table), parent, np.arange(len(parent)) >= len(stays)))
    return edits


def depth_outside(position: np.ndarray, region: Region, reach: np.ndarray | float = 0.0) -> np.ndarray:
    """Signed distance (N,) of points (N, 3) from the region's border in its radii, negative inside. Below a
    plane that of the lower end counts, `reach` (N, P) below the point along the plane's normal."""
    sphere = np.linalg.norm(position - np.array(region.centre), axis=1) / region.radius - 1
    below = (reach - region.heights(position)) / region.radius
    return np.asarray(np.maximum(sphere, below.max(axis=1, initial=-np.inf)))


def reach_of(table: dict[str, np.ndarray], region: Region) -> np.ndarray:
    """Extent (N, P) of surfels along the normals of a region's planes, scene units: REACH deviations."""
    axes, deviations = primitive_of(table).extent(table)
    normals = np.array(region.planes).reshape(-1, 4)[:, :3]
    along = np.einsum("nai,pi->npa", axes, normals) * deviations[:, None]
    return np.asarray(REACH * np.linalg.norm(along, axis=-1))
