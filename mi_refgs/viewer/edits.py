"""What the sliders do to a scene."""

from __future__ import annotations

import numpy as np

from mi_refgs.editing import Change, Selection, apply, assignments, select
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.surfels.attributes import sigmoid


def selected(where: str, scene: TrainedScene) -> np.ndarray:
    """The surfels (N,) bool that meet an expression of `editing`; all for an empty one.

    Raises InputError for a text that is none, and if no surfel does.
    """
    return select(scene, Selection(where=where.strip() or None))


def with_material(scene: TrainedScene, mask: np.ndarray, values: dict[str, float]) -> TrainedScene:
    """The scene with these values of channels in 0 … 1 for the selected surfels."""
    return apply(scene, mask, Change(set=assignments(values)))


def mean_of(scene: TrainedScene, mask: np.ndarray, name: str) -> float:
    """Mean of a channel in 0 … 1 over the selected surfels."""
    return float(sigmoid(scene.surfels.to_numpy()[name][mask, 0]).mean())
