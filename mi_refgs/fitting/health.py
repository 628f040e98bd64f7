"""When the loss or a gradient is not finite: the surfels that cause it go, or one sentence ends the fit.

The optimiser does not apply such steps, so the state is always the last good one.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fitting.optim import Skipped
from mi_refgs.methods.method import LIGHT
from mi_refgs.methods.surroundings import BACKGROUND
from mi_refgs.runs.checkpoint import channels_of
from mi_refgs.shade.light.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels

if TYPE_CHECKING:
    from mi_refgs.fitting.train import Trainer

CULL_SHARE = 0.1
"""Share of the surfels from which on a fault is not theirs: a pixel has tens of them, a table thousands."""
PATIENCE = 3
"""Intervals of the log in which every step fails before a fit gives up. Removing surfels may help first."""
NAMED = 5
"""Surfels that a message names."""


def check(fit: Trainer) -> None:
    """Remove the surfels that made steps fail since the last check; see `Trainer.check`."""
    skipped, steps = fit.optimiser.report(), fit.iteration - fit.checked
    fit.checked, fit.skipped = fit.iteration, fit.skipped + skipped.count
    fit.failed = fit.failed + steps if skipped.count >= steps else 0
    check_light(fit.light)
    if fit.surroundings is not None:
        check_light(fit.surroundings.background, BACKGROUND)
    found = {table: culprits(table.surfels, skipped, table.prefix) for table in fit.control.tables}
    rows = {table.prefix + name: at for table, names in found.items() for name, at in names.items()}
    if not rows and not skipped.count:
        return
    view = fit.data.views[fit.schedule.view(skipped.iteration + 1)].name if skipped.count else ""
    said = sentence(rows, skipped, view)
    fit.notices.append(said)
    if fit.failed >= PATIENCE * fit.method.log_every:
        raise gave_up(said, fit.failed)
    for table, names in found.items():
        if names:
            fit.control.remove(together(names), table)


def culprits(surfels: Surfels, skipped: Skipped, prefix: str = "") -> dict[str, np.ndarray]:
    """Rows that spoil steps, by channel: those with values that are not usable, else those whose gradient is
    not finite.

    Empty if the fault is none of the surfels'. `prefix` begins the names of the table's parameters.
    """
    if unusable := surfels.unusable():
        return unusable
    found = channels_of(skipped.rows, prefix)
    return found if len(together(found)) <= CULL_SHARE * surfels.count else {}


def together(rows: Mapping[str, np.ndarray]) -> np.ndarray:
    """The rows of all channels, each once, in order."""
    return np.unique(np.concatenate([*rows.values(), np.zeros(0, np.int64)])).astype(np.int64)


def sentence(rows: Mapping[str, np.ndarray], skipped: Skipped, view: str) -> str:
    """What happened, for people: iteration, view, channels and surfels."""
    channels = ", ".join(rows or skipped.rows) or "the loss"
    where = f"iteration {skipped.iteration + 1}, view {view}: " if skipped.count else ""
    indices = together(rows)
    if not len(indices):
        return f"{where}{channels} not finite; {skipped.count} steps were left out"
    named = ", ".join(map(str, indices[:NAMED])) + (" …" if len(indices) > NAMED else "")
    return f"{where}{channels} not finite at surfels {named}: {len(indices)} were removed"


def check_light(light: EnvironmentLight | None, name: str = LIGHT) -> None:
    """Raise InputError if the environment has a texel that renders black and learns no more."""
    if light is not None and light.unusable():
        rate = "rates.light" if name == LIGHT else "surroundings.rate"
        raise InputError(
            f"{name}: a texel is not finite or too large; go on from a checkpoint with a lower {rate}"
        )


def gave_up(said: str, steps: int) -> InputError:
    """What to raise after so many failed steps in a row."""
    return InputError(
        f"{said}; nothing was learnt in {steps} iterations: look at that picture and its camera, or lower "
        "the rates (--set rates.…)"
    )
