"""Selection of surfels by their values and their positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.editing.options import Selection
from mi_refgs.editing.values import SurfelValues, parse_condition
from mi_refgs.errors import InputError
from mi_refgs.runs.trained_scene import TrainedScene


def select(scene: TrainedScene, selection: Selection) -> np.ndarray:
    """Return the selected surfels (N,) bool; raises InputError for bad conditions, or if none is selected."""
    count = scene.surfels.count
    chosen = np.ones(count, bool)
    position = scene.surfels.to_numpy()["position"].astype(np.float64)
    if selection.where is not None:
        chosen &= SurfelValues(scene).where(parse_condition(selection.where))
    if selection.box is not None:
        corners = finite("--box", selection.box, 6).reshape(2, 3)
        chosen &= np.all((position >= corners.min(0)) & (position <= corners.max(0)), axis=1)
    if selection.nearest is not None and count:
        *point, radius = finite("--nearest", selection.nearest, 4)
        if radius < 0:
            raise InputError(f"the distance {radius:g} is negative", "--nearest", remedy="give one from 0")
        middle = position[np.argmin(np.linalg.norm(position - point, axis=1))]
        chosen &= np.linalg.norm(position - middle, axis=1) <= radius
    chosen = ~chosen if selection.invert else chosen
    if not chosen.any():
        raise InputError(f"none of the {count} surfels is in it", "selection", remedy="choose a wider one")
    return chosen


def finite(where: str, numbers: Sequence[float], count: int) -> np.ndarray:
    """Return numbers (count,) float64; raises InputError that starts with `where` for anything else."""
    try:
        found = np.asarray(numbers, dtype=np.float64)
    except (ValueError, TypeError):
        found = np.zeros(0)
    if found.shape != (count,) or not (np.abs(found) <= MAX_NUMBER).all():
        what = f"{count} finite numbers are needed, none beyond {MAX_NUMBER:g}"
        raise InputError(what, where, remedy="give them")
    return found
