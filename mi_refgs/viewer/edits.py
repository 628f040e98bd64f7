"""What the sliders do to a scene."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from mi_refgs.errors import InputError, shown
from mi_refgs.runs.export import TrainedScene
from mi_refgs.surfels.channels import logit, sigmoid
from mi_refgs.surfels.table import Surfels

COMPARISON = re.compile(r"\s*(roughness|metallic|opacity)\s*([<>])\s*(\d*\.?\d+)\s*")


def selected(where: str, scene: TrainedScene) -> np.ndarray:
    """The surfels (N,) bool that meet comparisons joined by `and`; all for an empty text.

    Raises InputError for another text, and if none does.
    """
    mask = np.ones(scene.surfels.count, bool)
    raw = scene.surfels.to_numpy()
    for part in where.split(" and ") if where.strip() else ():
        found = COMPARISON.fullmatch(part)
        if found is None or found[1] not in raw:
            raise InputError(f"selection: {shown(where)}: not understood; write it like metallic > 0.5")
        values = sigmoid(raw[found[1]][:, 0])
        mask &= values < float(found[3]) if found[2] == "<" else values > float(found[3])
    if not mask.any():
        raise InputError(f"selection: {shown(where)}: no surfel is in it; choose a wider one")
    return mask


def with_material(scene: TrainedScene, mask: np.ndarray, values: dict[str, float]) -> TrainedScene:
    """The scene with these values of channels in 0 … 1 for the selected surfels."""
    raw = scene.surfels.to_numpy()
    for name, value in values.items():
        raw[name][mask] = np.float32(logit(value))
    return replace(scene, surfels=Surfels.from_numpy(raw))


def mean_of(scene: TrainedScene, mask: np.ndarray, name: str) -> float:
    """Mean of a channel in 0 … 1 over the selected surfels."""
    return float(sigmoid(scene.surfels.to_numpy()[name][mask, 0]).mean())
