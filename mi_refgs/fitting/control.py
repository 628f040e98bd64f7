"""Adaptive control: densification, pruning, resets, propagation and restarts of a fit's surfels.

Surfels that cross the border of the region of interest change tables: one of the object that is more than
MARGIN radii outside becomes one of the background, with its geometry and the spherical harmonics of the
background; one of the background that is as far inside becomes one of the object, whose other attributes
start as the method says. Neither has a history in its new table. A table takes no more than its `max_count`,
and keeps at least one surfel.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.object_region import in_free_space
from mi_refgs.data.region import Region
from mi_refgs.data.view import evenly_spread
from mi_refgs.fitting import refine
from mi_refgs.fitting.initial import converted, first_light
from mi_refgs.fitting.refine import TableEdit
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.methods.method import LIGHT, Method
from mi_refgs.splat import surfel_count
from mi_refgs.splat.weights import blended_weights, listed_tiles
from mi_refgs.surfels.primitives import primitive_of
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

WEIGHED_VIEWS, WEIGHED_SIZE = 48, 128
"""Training views in which faint surfels are looked for at most, and the longer side of their images there in
pixels: an event then takes as long as 5 to 10 steps."""
REACH = 2.0
"""Standard deviations to which a surfel extends: one that extends through the plane below the object is the
table's. On *tabletop*, the opacity of the object alone has an intersection over union with the jug's mask of
0.90 by centres, 0.94 with 1, 0.96 with 2 and 3."""
MARGIN = 0.02  # distance beyond the border of the region, in radii, from which a surfel changes tables


def depth_outside(position: np.ndarray, region: Region, reach: np.ndarray | float = 0.0) -> np.ndarray:
    """Signed distance (N,) of points (N, 3) from the region's border in its radii, negative inside.

    From planes, it is the distance of the lower ends of what extends by `reach` (N, P) along their normals.
    """
    sphere = np.linalg.norm(position - np.array(region.centre), axis=1) / region.radius - 1
    below = (reach - region.heights(position)) / region.radius
    return np.asarray(np.maximum(sphere, below.max(axis=1, initial=-np.inf)))


def reach_of(table: dict[str, np.ndarray], region: Region) -> np.ndarray:
    """Extent (N, P) of surfels along the normals of a region's planes, scene units: REACH deviations."""
    axes, deviations = primitive_of(table).extent(table)
    normals = np.array(region.planes).reshape(-1, 4)[:, :3]
    along = np.einsum("nai,pi->npa", axes, normals) * deviations[:, None]
    return np.asarray(REACH * np.linalg.norm(along, axis=-1))


def exchanged(
    inner: Surfels, outer: Surfels, method: Method, region: Region, rng: np.random.Generator
) -> list[TableEdit]:
    """Both tables after surfels beyond the border have changed tables.

    One of another primitive keeps its axes and sizes, as far as it has them. A table may become larger than
    its method allows, and does not grow then.
    """
    tables = [inner.to_numpy(), outer.to_numpy()]
    own_depth, other_depth = (
        depth_outside(table["position"], region, reach_of(table, region)) for table in tables
    )
    leaves = [own_depth > MARGIN, other_depth < -MARGIN]
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


class AdaptiveControl:
    """Applies the edits of a method to the state of a fit after its steps."""

    def __init__(self, setup: FitSetup, state: FitState) -> None:
        self.setup, self.state = setup, state
        self.options = setup.method.refine

    def observes(self, iteration: int) -> bool:
        """Whether a later densification requires the errors of this iteration."""
        return self.options.densify is not None and iteration <= self.options.densify.until

    def observe(self, error: Float) -> None:
        """Add the squared errors (N,) of an iteration by responsible surfel, the object's first."""
        if len(self.state.tables) == 1:
            self.state.tables[0].observe(error)
            return
        begin = mi.UInt32(0)
        for table in self.state.tables:
            count = dr.width(table.error_sum)
            table.observe(dr.gather(mi.Float, error, dr.arange(mi.UInt32, count) + begin))
            begin = dr.opaque(mi.UInt32, count)

    def changes_rows(self, iteration: int) -> bool:
        """Whether surfels are added or removed after this iteration."""
        return self.options.densify is not None and self.options.densify.due(iteration)

    def refine(self, iteration: int) -> None:
        """Apply the edits that are due after this iteration."""
        options, state = self.options, self.state
        if options.densify is not None and options.densify.due(iteration):
            self._densify(iteration)

        # Resets and propagation: of the object only, since the background map would replace the background's
        # surfels, blurred.
        if options.reset is not None and options.reset.due(iteration):
            floors = {name: self.setup.method.surfels.start(name) for name in options.reset_raise}
            edited = refine.reset_opacity(state.surfels, options, floors)
            state.tables[0].replace(edited, cleared=("opacity", *floors))
        elif options.propagate is not None and options.propagate.when.due(iteration):
            draws = self.setup.rng(iteration, "propagate")
            edited = refine.propagate_normals(state.surfels, options.propagate, draws)
            colour = ("radiance_sh",) if options.propagate.noise else ()
            state.tables[0].replace(edited, cleared=("opacity", *edited.primitive.sizes, *colour))
            state.optimiser.set_factor("opacity", 0.0)
            state.held_until = iteration + options.propagate.hold
        if iteration >= state.held_until:
            state.optimiser.set_factor("opacity", 1.0)

    def fill(self) -> None:
        """Split the object's surfels with the largest error, as many as there is room for; prune none."""
        table, options = self.state.tables[0], replace(self.options, grow=1.0, prune_opacity=0.0)
        error = table.error_sum.numpy()
        table.apply(
            refine.densify_and_prune(table.surfels, error, refine.NO_ROWS, np.inf, options, table.max_count)
        )
        self.state.occluder.vertex_surfels = None
        table.clear()

    def _densify(self, iteration: int) -> None:
        """Grow where the error is, prune, and let surfels of an open scene change tables."""
        options, data, method, state = self.options, self.setup.data, self.setup.method, self.state
        region = state.region or data.region
        since_reset = options.reset.since(iteration) if options.reset is not None else None
        if since_reset is not None and since_reset < refine.prune_wait(options, method.rates.of("opacity")):
            options = replace(options, prune_opacity=0.0)
        if self.setup.open_scene:
            assert region is not None
            self._clear_free_space(region)
        faint = self._faint() if options.prune_opacity else [refine.NO_ROWS] * len(state.tables)
        for table, few in zip(state.tables, faint, strict=True):
            surfels, is_background = table.surfels, bool(table.prefix)
            largest: float | np.ndarray = options.prune_extent * data.scene_extent
            if is_background:  # its surfels may grow with their distance
                assert region is not None and method.surroundings is not None
                offset = surfels.raw["position"].numpy() - np.array(region.centre)
                distance = np.maximum(np.linalg.norm(offset, axis=1), region.radius)
                largest = method.surroundings.prune_extent * distance
            error = table.error_sum.numpy()
            table.apply(
                refine.densify_and_prune(
                    surfels, error, few, largest, options, table.max_count, keep_one=is_background
                )
            )
        if self.setup.open_scene:
            assert region is not None
            self.exchange(region, iteration)
        state.occluder.vertex_surfels = None
        for table in state.tables:
            table.clear()

    def _clear_free_space(self, region: Region) -> None:
        """Remove the background's surfels right in front of cameras; one stays in any case."""
        background = self.state.tables[1]
        floating = in_free_space(self.setup.data.views, region, background.surfels.raw["position"].numpy())
        floating &= np.cumsum(floating) < len(floating)
        if floating.any():
            background.remove(np.flatnonzero(floating))

    def _faint(self) -> list[np.ndarray]:
        """The rows of each table with the least blending weight for the tiles they cost, these first."""
        every, own = self.state.detached(), self.state.surfels.count
        views = self.setup.data.views
        cameras = (views[i].camera() for i in evenly_spread(len(views), WEIGHED_VIEWS))
        weight, cost = np.zeros(surfel_count(every)), np.zeros(surfel_count(every))
        for camera in cameras:
            small = camera.resized(min(WEIGHED_SIZE, max(camera.width, camera.height)))
            weight += blended_weights(every, small)[0]
            cost += listed_tiles(every, small)
        tables = zip(np.split(weight, [own]), np.split(cost, [own]), strict=True)
        share, count = self.options.prune_weight, len(self.state.tables)
        return [refine.least_weight(w, c, share) for w, c in tables][:count]

    def exchange(self, region: Region, iteration: int) -> None:
        """Let the surfels beyond the border of a region change tables."""
        inner, outer = (table.surfels for table in self.state.tables)
        edits = exchanged(inner, outer, self.setup.method, region, self.setup.rng(iteration, "densify"))
        for table, edit in zip(self.state.tables, edits, strict=True):
            table.apply(edit)
        self.state.occluder.vertex_surfels = None

    def restart(self, names: tuple[str, ...], iteration: int) -> None:
        """Set attributes, and the light if it is named, back to their initial values, without history."""
        state, method = self.state, self.setup.method
        starts = {name: method.surfels.start(name) for name in names if name != LIGHT}
        draws = self.setup.rng(iteration, "restart")
        state.tables[0].replace(refine.restart(state.surfels, starts, draws), cleared=tuple(starts))
        if LIGHT in names and method.light is not None:
            state.params[LIGHT] = first_light(method.light).raw
            state.optimiser.reset(LIGHT)
