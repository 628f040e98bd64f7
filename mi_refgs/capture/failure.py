"""Why a set of photographs could not be placed, and what to photograph differently."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError

FEW_FEATURES = 60
"""Least number of features of the median picture: a pair needs 15 matches that agree, and a quarter of the
features is a good share."""
FLAT_CONTRAST = 0.04
"""Standard deviation of a picture's brightness, 0 … 1, below which it shows one even colour."""
LEAST_PLACED = 0.5
"""Share of the photographs that must be placed in one group: less is not the scene that was meant."""
TURN_SHARE = 0.8
"""Share of the matched pairs that a turn or a plane explains, from which the camera has probably only
turned."""
NAMED = 5
"""Largest number of photographs that a message names."""


def check_features(folder: Path, counts: Sequence[int], contrast: float) -> None:
    """Raise InputError where the median picture has hardly any features; `contrast`: of the median
    picture."""
    median = int(np.median(counts))
    if median >= FEW_FEATURES:
        return
    if contrast < FLAT_CONTRAST:
        reason = "they show even colour"
        remedy = "put the object on a patterned ground, such as a newspaper,"
    else:
        reason = "they are blurred, or show hardly any texture"
        remedy = "hold still, use more light, put a patterned ground below the object,"
    raise InputError(
        f"{folder}: photographs: half of them have no more than {median} distinct places: {reason}; "
        f"{remedy} and photograph it anew"
    )


def no_model(folder: Path, count: int, pairs: Sequence[tuple[str, str, int, bool]]) -> InputError:
    """What to raise where no two pictures were fit to begin with; `pairs`: from `colmap.verified`."""
    if not pairs:
        reason = f"no two of the {count} show the same places"
        remedy = "take more, so close that each shows two thirds of the one before"
    elif np.mean([flat for *_, flat in pairs]) >= TURN_SHARE:
        reason = "they seem to be taken from one place, so nothing shows depth"
        remedy = "walk around the object instead of turning the camera"
    else:
        reason = f"of the {count}, no two with enough in common look from different enough sides"
        remedy = "take more on a circle around the object, 5° to 10° apart"
    return InputError(f"{folder}: photographs: {reason}; {remedy}")


def check_placed(folder: Path, count: int, groups: Sequence[Sequence[str]], longest_gap: str) -> None:
    """Raise InputError unless the largest group has half of the pictures; `longest_gap`: a name beside the
    gap."""
    if len(groups[0]) >= LEAST_PLACED * count:
        return
    sizes = ", ".join(str(len(group)) for group in groups)
    apart = (
        f"{len(groups)} groups that share nothing ({sizes} pictures)"
        if len(groups) > 1
        else f"{sizes} pictures"
    )
    raise InputError(
        f"{folder}: photographs: of {count}, only {apart} could be placed; take pictures that lead from one "
        f"group to the next in small steps, as around {longest_gap}"
    )


def some(names: Sequence[str]) -> str:
    """Some names for a message."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more
