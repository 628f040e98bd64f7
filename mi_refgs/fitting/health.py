"""Steps whose loss or gradient is not finite: the surfels that cause them are removed, or the fit ends.

The optimiser does not apply such steps, so the state is always the last good one."""

from collections.abc import Mapping
from dataclasses import dataclass

import drjit as dr
import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fitting.optim import Skipped
from mi_refgs.fitting.schedule import FitSetup
from mi_refgs.fitting.state import FitState
from mi_refgs.methods.method import BACKGROUND, LIGHT
from mi_refgs.runs.checkpoint import channels_of
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float

CULL_SHARE = 0.1  # fraction of the surfels from which on they are not the cause: a pixel has tens
PATIENCE = 3  # log intervals of failed steps before a fit ends, at its end 1: removing surfels may help first


@dataclass
class Health:
    """Counts the steps that changed nothing, and removes the surfels that caused them."""

    skipped: int = 0  # steps that changed nothing, since their loss or gradient was not finite
    checked: int = 0  # iteration of the last check
    failed: int = 0  # steps that failed in a row

    def check(self, setup: FitSetup, state: FitState, terms: Mapping[str, Float]) -> str | None:
        """Remove the surfels that made steps fail since the last check; returns a sentence about it, if any.
        Raises InputError if the light is not finite, if no surfel is left, or if nothing helps."""
        skipped, steps = state.optimiser.report(), state.iteration - self.checked
        self.checked, self.skipped = state.iteration, self.skipped + skipped.count
        self.failed = self.failed + steps if skipped.count >= steps else 0
        background = None if state.surroundings is None else state.surroundings.background
        for name, light in ((LIGHT, state.light), (BACKGROUND, background)):
            if light is not None and light.unusable():  # its texel renders black, and no longer learns
                remedy = "go on from a checkpoint with a lower rates.light"
                raise InputError("a texel is not finite or too large", field=name, remedy=remedy)
        found = [(table, culprits(table.surfels, skipped, table.prefix)) for table in state.tables]
        rows = {table.prefix + name: at for table, names in found for name, at in names.items()}
        if not rows and not skipped.count:
            return None
        wrong = [f"loss '{name}'" for name, value in terms.items() if not dr.all(dr.isfinite(value))[0]]
        channels = ", ".join(rows or wrong or skipped.rows) or "the loss"
        views, iteration = setup.data.views, skipped.iteration + 1
        where = f"iteration {iteration}, view {views[setup.view(iteration)].name}: " if skipped.count else ""
        said = f"{where}{channels} not finite; {skipped.count} steps were left out"
        if len(indices := together(rows)):
            named = ", ".join(map(str, indices[:5])) + (" …" if len(indices) > 5 else "")
            said = f"{where}{channels} not finite at surfels {named}: {len(indices)} were removed"
        wait = PATIENCE if rows or state.iteration < setup.method.iterations else 1
        if self.failed >= min(wait * setup.method.log_every, setup.method.iterations):
            remedy = "look at that image, its camera and that loss, or lower the rates (--set rates.…)"
            raise InputError(f"{said}; nothing was learnt in {self.failed} iterations: {remedy}")
        for table, names in found:
            if names:
                table.remove(together(names))
        return said


def culprits(surfels: Surfels, skipped: Skipped, prefix: str = "") -> dict[str, np.ndarray]:
    """Rows that cause failed steps, by attribute: with unusable values, or else such gradients."""
    if unusable := surfels.unusable():
        return unusable
    found = channels_of(skipped.rows, prefix)
    return found if len(together(found)) <= CULL_SHARE * surfels.count else {}


def together(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """The rows of all attributes, each once, sorted."""
    return np.unique(np.concatenate([*rows.values(), np.zeros(0, np.int64)])).astype(np.int64)
