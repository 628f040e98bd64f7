"""An object that is painted on views: its surfels, also those that no painted view shows."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from mi_refgs.editing.selection import PAINTED_SHARE, shown_weights
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera

CLEAR = 0.5
"""Blended weight, over the median of a view, from which a surfel that is not painted is decided. Those at an
outline have less, and lie outside of the painted pixels: of a ball's surfels 55 % would be found, not all."""


class Painting:
    """The surfels of an object of which pixels are painted, in one view or in several.

    Surfels that a view with painted pixels shows clearly are decided: painted ones are the object's, others
    stay what they were. All others are what the nearest surfel is that is decided or background.
    """

    def __init__(self, scene: TrainedScene) -> None:
        """Begin with nothing painted."""
        self.scene = scene
        self.position = scene.surfels.to_numpy()["position"].astype(np.float64)
        around = scene.surroundings
        others = np.zeros((0, 3)) if around is None else around.surfels.to_numpy()["position"]
        self.background = others.astype(np.float64)
        self.decided = self.chosen = np.zeros(len(self.position), bool)
        self._before: list[tuple[np.ndarray, np.ndarray]] = []

    def paint(self, camera: Camera, mask: np.ndarray, *, remove: bool = False) -> None:
        """Add what painted pixels, `mask` (H, W) bool, show in a view to the object, or remove it.

        Raises InputError for a mask of another size than the view.
        """
        every, inside = shown_weights(self.scene, camera, mask)
        hit, seen = inside > PAINTED_SHARE * every, every > 0
        clear = every > CLEAR * np.median(every[seen]) if seen.any() else seen
        self._before.append((self.decided, self.chosen))
        self.chosen = np.where(hit, not remove, self.surfels())
        self.decided = self.decided | hit | clear

    def undo(self) -> None:
        """Undo the last `paint` that is not undone."""
        if self._before:
            self.decided, self.chosen = self._before.pop()

    def surfels(self) -> np.ndarray:
        """The object's surfels (N,) bool."""
        chosen = self.chosen & self.decided
        if chosen.any():
            known = np.concatenate([self.position[self.decided], self.background])
            label = np.pad(self.chosen[self.decided], (0, len(self.background)))
            chosen[~self.decided] = label[KDTree(known).query(self.position[~self.decided])[1]]
        return chosen
