"""What a fit does to its tables beside learning: densify, prune, reset, propagate, restart, remove."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.region import Region
from mi_refgs.errors import InputError
from mi_refgs.fitting import refine
from mi_refgs.fitting.initial import first_light
from mi_refgs.fitting.refine import TableEdit, relocate, wander
from mi_refgs.kernels.device import upload
from mi_refgs.methods.method import LIGHT, Method
from mi_refgs.methods.surroundings import AROUND
from mi_refgs.runs.checkpoint import channels_of
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import attribute
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer

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
            made[name] = attribute(name).start(count, width, rng, method.surfels.start(name))
    return {name: values.astype(np.float32) for name, values in made.items()}


class Table:
    """The rows of the parameters whose names are `prefix` and a channel, and how their pixels moved."""

    def __init__(self, trainer: Trainer, prefix: str = "") -> None:
        self.trainer, self.prefix = trainer, prefix
        self.gradient_sum: Any = None  # of each surfel since it was densified last, and of how many views
        self.gradient_count: Any = None

    @property
    def surfels(self) -> Surfels:
        """The table, attached to the leaves that the optimiser owns."""
        return Surfels(channels_of(self.trainer.params, self.prefix))

    @property
    def max_count(self) -> int:
        """Most rows that the method allows."""
        method = self.trainer.method
        options = method.surroundings if self.prefix else method.surfels
        assert options is not None
        return options.max_count

    @property
    def gradient(self) -> np.ndarray:
        """Mean length of the gradients that were observed (N,); waits for the device."""
        mean: np.ndarray = self.gradient_sum.numpy() / np.maximum(self.gradient_count.numpy(), 1)
        return mean

    def clear(self) -> None:
        """Forget the statistics."""
        count = self.surfels.count
        self.gradient_sum = dr.opaque(mi.Float, 0, count)
        self.gradient_count = dr.opaque(mi.Float, 0, count)

    def observe(self, length: Any) -> None:
        """Take in the lengths of a step's gradients with respect to places on the screen, in NDC units."""
        seen = (length > 0) & dr.isfinite(length)
        self.gradient_sum += dr.select(seen, length, 0.0)
        self.gradient_count += dr.select(seen, mi.Float(1), 0)
        dr.schedule(self.gradient_sum, self.gradient_count)

    def adopt(self, edit: TableEdit) -> None:
        """Put an edited table in place of the present one; moments and statistics follow the rows."""
        edit = edit.ordered()
        parent, fresh = upload(edit.parent, mi.UInt32), upload(edit.fresh, mi.Bool)
        self.replace(edit.surfels)
        self.trainer.optimiser.gather(parent, self._names(edit.surfels), fresh)
        self.gradient_sum = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_sum, parent))
        self.gradient_count = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_count, parent))
        dr.eval(self.gradient_sum, self.gradient_count)

    def remove(self, rows: np.ndarray) -> None:
        """Take surfels out of the table; raises InputError if none would be left."""
        surfels = self.surfels
        parent = np.delete(np.arange(surfels.count), rows)
        if not len(parent):
            raise InputError("surfels: none of them is finite; lower the rates (--set rates.…)")
        index = upload(parent, mi.UInt32)
        self.replace(surfels.gather(index))
        self.trainer.optimiser.gather(index, self._names(surfels))
        self.gradient_sum = dr.gather(mi.Float, self.gradient_sum, index)
        self.gradient_count = dr.gather(mi.Float, self.gradient_count, index)

    def replace(self, surfels: Surfels, cleared: tuple[str, ...] = ()) -> None:
        """Put a table in place of the present one; `cleared` channels lose their moments."""
        fit = self.trainer
        fit.params.update({self.prefix + name: tensor for name, tensor in surfels.raw.items()})
        dr.enable_grad([fit.params[name] for name in self._names(surfels)])
        for name in cleared:
            if self.prefix + name in fit.params:
                fit.optimiser.reset(self.prefix + name)

    def state(self) -> dict[str, np.ndarray]:
        """The statistics, for a checkpoint."""
        return {
            f"{self.prefix}gradient_sum": self.gradient_sum.numpy(),
            f"{self.prefix}gradient_count": self.gradient_count.numpy(),
        }

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Go on where `state` was taken."""
        self.gradient_sum = upload(state[f"{self.prefix}gradient_sum"])
        self.gradient_count = upload(state[f"{self.prefix}gradient_count"])

    def _names(self, surfels: Surfels) -> list[str]:
        """The parameters of its channels."""
        return [self.prefix + name for name in surfels.raw]


class AdaptiveControl:
    """Statistics of the surfels of a fit, and the edits that its method asks for; moments follow the rows."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.held_until = 0  # iteration before which opacities do not learn
        self.table = Table(trainer)
        self.around = Table(trainer, AROUND)

    @property
    def tables(self) -> list[Table]:
        """The object's table, and that of the surroundings if there is one."""
        return [self.table, self.around] if self.trainer.open else [self.table]

    def clear(self) -> None:
        """Forget the statistics."""
        for table in self.tables:
            table.clear()

    def observe(self, δshift: Any, camera: Camera, iteration: int) -> None:
        """Take in the gradients of a step with respect to the surfels' places on the screen, in pixels."""
        densify = self.trainer.method.refine.densify
        if densify is None or iteration > densify.until:
            return
        length = dr.norm(δshift * mi.Vector2f(0.5 * camera.width, 0.5 * camera.height))
        if not self.trainer.open:
            self.table.observe(length)
            return
        begin = mi.UInt32(0)
        for table in self.tables:
            count = dr.width(table.gradient_sum)
            table.observe(dr.gather(mi.Float, length, dr.arange(mi.UInt32, count) + begin))
            begin = dr.opaque(mi.UInt32, count)

    def refine(self, iteration: int) -> None:
        """Edit the tables by what falls due after this iteration."""
        fit = self.trainer
        options, surfels = fit.method.refine, fit.method.surfels
        if options.densify is not None and options.densify.due(iteration):
            self._densify(iteration)
        if options.relocate is not None and options.relocate.when.due(iteration):
            fit.check()
            draws = fit.schedule.rng(iteration, "relocate")
            for table in self.tables:
                table.adopt(relocate(table.surfels, options.relocate, table.max_count, draws))
            fit.occluder.vertex_surfels = None
        if options.reset is not None and options.reset.due(iteration):
            floors = {name: surfels.start(name) for name in options.reset_raise}
            # Surroundings keep theirs: without, the background takes their place, blurred.
            self.table.replace(
                refine.reset_opacity(fit.surfels, options, floors), cleared=("opacity", *floors)
            )
        elif options.propagate is not None and options.propagate.when.due(iteration):
            colour = ("radiance_sh",) if options.propagate.noise else ()
            self.table.replace(
                refine.propagate_normals(
                    fit.surfels, options.propagate, fit.schedule.rng(iteration, "propagate")
                ),
                cleared=("opacity", *fit.surfels.primitive.sizes, *colour),
            )
            fit.optimiser.set_factor("opacity", 0.0)
            self.held_until = iteration + options.propagate.hold
        if iteration >= self.held_until:
            fit.optimiser.set_factor("opacity", 1.0)

    def _densify(self, iteration: int) -> None:
        fit = self.trainer
        fit.check()
        options, draws = fit.method.refine, fit.schedule.rng(iteration, "densify")
        since_reset = options.reset.since(iteration) if options.reset is not None else None
        wait = refine.prune_wait(options, fit.method.rates.of("opacity"))
        prune_transparent = since_reset is None or since_reset >= wait
        for table in self.tables:
            extent: Any = fit.extent
            largest = None
            if table is self.around:
                assert fit.data.region is not None and fit.method.surroundings is not None
                distance = distances(table.surfels, fit.data.region)
                largest = fit.method.surroundings.prune_extent * distance
                extent = np.maximum(distance, fit.extent)
            edit = refine.densify_and_prune(
                table.surfels,
                table.gradient,
                extent,
                options,
                table.max_count,
                draws,
                prune_transparent=prune_transparent,
                largest=largest,
            )
            table.adopt(edit)
        if fit.open:
            assert fit.data.region is not None
            inner, outer = (table.surfels for table in self.tables)
            edits = exchanged(inner, outer, fit.method, fit.data.region, draws)
            for table, edit in zip(self.tables, edits, strict=True):
                table.adopt(edit)
        fit.occluder.vertex_surfels = None
        self.clear()

    def wander(self, iteration: int) -> None:
        """The random step of positions that follows the optimiser's."""
        fit = self.trainer
        options = fit.method.refine.relocate
        if options is None or not options.noise or not options.when.start < iteration <= options.when.until:
            return
        for table in self.tables:
            name = f"{table.prefix}position"
            rate = fit.optimiser.rate(name, iteration - 1) / fit.extent
            moved = wander(table.surfels, rate, fit.extent, options, iteration, fit.method.seed)
            dr.eval(moved)
            dr.enable_grad(moved)
            fit.params[name] = moved

    def remove(self, rows: np.ndarray, table: Table | None = None) -> None:
        """Take surfels out of a table, by default the object's; raises InputError if none would be left."""
        (table or self.table).remove(rows)
        self.trainer.occluder.vertex_surfels = None

    def restart(self, names: tuple[str, ...], iteration: int) -> None:
        """Channels and the light back to their initial values, without history."""
        fit = self.trainer
        starts = {name: fit.method.surfels.start(name) for name in names if name != LIGHT}
        edited = refine.restart(fit.surfels, starts, fit.schedule.rng(iteration, "restart"))
        self.table.replace(edited, cleared=tuple(starts))
        if LIGHT in names and fit.method.light is not None:
            fit.params[LIGHT] = first_light(fit.method.light).raw
            fit.optimiser.reset(LIGHT)
