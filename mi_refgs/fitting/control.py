"""What a fit does to its tables beside learning: densify, prune, reset, propagate, restart, remove."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.fitting import refine
from mi_refgs.fitting.exchange import distances, exchanged
from mi_refgs.fitting.initial import first_light
from mi_refgs.fitting.relocate import relocate, wander
from mi_refgs.fitting.tables import Table
from mi_refgs.methods.method import LIGHT
from mi_refgs.methods.surroundings import AROUND
from mi_refgs.splat import Camera

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer


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
