"""What a fit does to its table beside learning: densify, prune, reset, propagate, restart, remove."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.device import upload
from mi_refgs.errors import InputError
from mi_refgs.fit import refine
from mi_refgs.fit.refine import TableEdit
from mi_refgs.fit.relocate import relocate, wander
from mi_refgs.methods.method import LIGHT, LightOptions
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.splat import Camera
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.fit.train import Trainer


def first_light(options: LightOptions) -> EnvironmentLight:
    """The environment that a fit starts with: one radiance everywhere."""
    return EnvironmentLight.constant(options.radiance, options.height)


class AdaptiveControl:
    """Statistics of the surfels of a fit, and the edits that its method asks for; moments follow the rows."""

    def __init__(self, trainer: Trainer) -> None:
        self.trainer = trainer
        self.held_until = 0  # iteration before which opacities do not learn
        self.gradient_sum: Any = None  # of each surfel since it was densified last, and of how many views
        self.gradient_count: Any = None

    def clear(self) -> None:
        """Forget the statistics."""
        count = self.trainer.surfels.count
        self.gradient_sum = dr.opaque(mi.Float, 0, count)
        self.gradient_count = dr.opaque(mi.Float, 0, count)

    def observe(self, δshift: Any, camera: Camera, iteration: int) -> None:
        """Take in the gradients of a step with respect to the surfels' places on the screen, in pixels."""
        densify = self.trainer.method.refine.densify
        if densify is None or iteration > densify.until:
            return
        length = dr.norm(δshift * mi.Vector2f(0.5 * camera.width, 0.5 * camera.height))
        seen = (length > 0) & dr.isfinite(length)
        self.gradient_sum += dr.select(seen, length, 0.0)
        self.gradient_count += dr.select(seen, mi.Float(1), 0)
        dr.schedule(self.gradient_sum, self.gradient_count)

    def refine(self, iteration: int) -> None:
        """Edit the table by what falls due after this iteration."""
        fit = self.trainer
        options, surfels = fit.method.refine, fit.method.surfels
        if options.densify is not None and options.densify.due(iteration):
            self._densify(iteration)
        if options.relocate is not None and options.relocate.when.due(iteration):
            fit.check()
            draws, limit = fit.schedule.rng(iteration), surfels.max_count
            self._adopt(relocate(fit.surfels, options.relocate, limit, draws))
        if options.reset is not None and options.reset.due(iteration):
            floors = {name: surfels.start(name) for name in options.reset_raise}
            self.replace(refine.reset_opacity(fit.surfels, options, floors), cleared=("opacity", *floors))
        elif options.propagate is not None and options.propagate.when.due(iteration):
            colour = ("radiance_sh",) if options.propagate.noise else ()
            self.replace(
                refine.propagate_normals(fit.surfels, options.propagate, fit.schedule.rng(iteration)),
                cleared=("opacity", *fit.surfels.primitive.sizes, *colour),
            )
            fit.optimiser.set_factor("opacity", 0.0)
            self.held_until = iteration + options.propagate.hold
        if iteration >= self.held_until:
            fit.optimiser.set_factor("opacity", 1.0)

    def _densify(self, iteration: int) -> None:
        fit = self.trainer
        fit.check()
        options = fit.method.refine
        since_reset = options.reset.since(iteration) if options.reset is not None else None
        wait = refine.prune_wait(options, fit.method.rates.of("opacity"))
        edited = refine.densify_and_prune(
            fit.surfels,
            self.gradient_sum.numpy() / np.maximum(self.gradient_count.numpy(), 1),
            fit.extent,
            options,
            fit.method.surfels.max_count,
            fit.schedule.rng(iteration),
            prune_transparent=since_reset is None or since_reset >= wait,
        )
        self._adopt(edited)
        self.clear()

    def _adopt(self, edit: TableEdit) -> None:
        """Put an edited table in place of the present one; moments and statistics follow the rows."""
        fit, edit = self.trainer, edit.ordered()
        parent, fresh = upload(edit.parent, mi.UInt32), mi.Bool(edit.fresh)
        self.replace(edit.surfels)
        fit.occluder.around = None
        fit.optimiser.gather(parent, list(edit.surfels.raw), fresh)
        self.gradient_sum = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_sum, parent))
        self.gradient_count = dr.select(fresh, 0, dr.gather(mi.Float, self.gradient_count, parent))
        dr.eval(self.gradient_sum, self.gradient_count)

    def wander(self, iteration: int) -> None:
        """The random step of positions that follows the optimiser's."""
        fit = self.trainer
        options = fit.method.refine.relocate
        if options is None or not options.noise or not options.when.start < iteration <= options.when.until:
            return
        rate = fit.optimiser.rate("position", iteration - 1) / fit.extent
        moved = wander(fit.surfels, rate, fit.extent, options, iteration, fit.method.seed)
        dr.eval(moved)
        dr.enable_grad(moved)
        fit.params["position"] = moved

    def remove(self, rows: np.ndarray) -> None:
        """Take surfels out of the table; raises InputError if none would be left."""
        fit = self.trainer
        parent = np.delete(np.arange(fit.surfels.count), rows)
        if not len(parent):
            raise InputError("surfels: none of them is finite; lower the rates (--set rates.…)")
        index = upload(parent, mi.UInt32)
        self.replace(fit.surfels.gather(index))
        fit.occluder.around = None
        fit.optimiser.gather(index, list(fit.surfels.raw))
        self.gradient_sum = dr.gather(mi.Float, self.gradient_sum, index)
        self.gradient_count = dr.gather(mi.Float, self.gradient_count, index)

    def restart(self, names: tuple[str, ...], iteration: int) -> None:
        """Channels and the light back to their initial values, without history."""
        fit = self.trainer
        starts = {name: fit.method.surfels.start(name) for name in names if name != LIGHT}
        self.replace(refine.restart(fit.surfels, starts, fit.schedule.rng(iteration)), cleared=tuple(starts))
        if LIGHT in names and fit.method.light is not None:
            fit.params[LIGHT] = first_light(fit.method.light).raw
            fit.optimiser.reset(LIGHT)

    def replace(self, surfels: Surfels, cleared: tuple[str, ...] = ()) -> None:
        """Put a table in place of the present one; `cleared` channels lose their moments."""
        fit = self.trainer
        fit.params.update(surfels.raw)
        for name in surfels.raw:
            dr.enable_grad(fit.params[name])
        for name in cleared:
            if name in fit.params:
                fit.optimiser.reset(name)
