"""When the loss or a gradient is not finite: the surfels that cause it go, or one sentence ends the fit.

The optimiser does not apply such steps, so the state is always the last good one.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.fit.skips import Skipped
from mi_refgs.methods.method import APART
from mi_refgs.shade.envmap import EnvironmentLight
from mi_refgs.surfels.table import Surfels

CULL_SHARE = 0.1
"""Share of the surfels from which on a fault is not theirs: a pixel has tens of them, a table thousands."""
PATIENCE = 3
"""Intervals of the log in which every step fails before a fit gives up. Removing surfels may help first."""
NAMED = 5
"""Surfels that a message names."""


def culprits(surfels: Surfels, skipped: Skipped) -> dict[str, np.ndarray]:
    """Rows that spoil steps, by channel: those with values that are not usable, else those whose gradient is
    not finite.

    Empty if the fault is none of the surfels'.
    """
    if unusable := surfels.unusable():
        return unusable
    found = {name: rows for name, rows in skipped.rows.items() if name not in APART}
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


def check_light(light: EnvironmentLight | None) -> None:
    """Raise InputError if the environment has a texel that renders black and learns no more."""
    if light is not None and light.unusable():
        raise InputError(
            "light: a texel is not finite or too large; go on from a checkpoint with a lower rates.light"
        )


def gave_up(said: str, steps: int) -> InputError:
    """What to raise after so many failed steps in a row."""
    return InputError(
        f"{said}; nothing was learnt in {steps} iterations: look at that picture and its camera, or lower "
        "the rates (--set rates.…)"
    )
