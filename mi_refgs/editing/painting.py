"""An object that is painted on views: its surfels, also those that no painted view shows."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy.spatial import KDTree

from mi_refgs.editing.selection import SurfelValues
from mi_refgs.kernels.device import upload
from mi_refgs.render.passes import in_passes
from mi_refgs.render.pipeline import render_depth
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera, splat, surfel_count
from mi_refgs.splat.weights import blended_weights
from mi_refgs.types import Float

PAINTED_SHARE = 0.5
"""Part of a surfel's blended weight that must lie in the painted pixels."""
BEHIND_SIZES = 3.0
"""Standard deviations of a surfel by which its centre may lie behind the depth that its pixels show. On a
mirror ball of 12,000 surfels, painted completely, 0.6 % of the far side are selected (5 % at 6, 38 % without
a limit), and 99.1 % of the weight that the image blends (96.6 % at 1, 99.7 % at 6)."""
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


def shown_weights(scene: TrainedScene, camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the blended weight of each surfel in a view, and that in painted pixels: (N,), pixels.

    It is 0 if the centre is more than BEHIND_SIZES behind the mean depth of the surfel's pixels, so that a
    far side that shines through is left out. The background occludes the object. Raises InputError for a
    mask of another size.
    """
    assert mask.shape == (camera.height, camera.width)
    own, background = scene.surfels.detach(), scene.surroundings
    others = None if background is None else background.surfels.detach()
    tables = [own] if others is None else [own, others]
    with dr.suspend_grad():
        depth, _ = render_depth(own, camera, others)
    maps = [upload(mask.astype(np.float32)), mi.Float(1), depth]
    inside, every, far = (weight[: own.count] for weight in blended_weights(tables, camera, maps))
    centre = np.array(camera.to_camera(own.position()).z, np.float64)
    pixel_depth = far / np.maximum(every, np.finfo(np.float64).tiny)
    behind = centre - pixel_depth > BEHIND_SIZES * SurfelValues(scene)["size"]
    return np.where(behind, 0, every), np.where(behind, 0, inside)


def selected_alpha(scene: TrainedScene, chosen: np.ndarray, camera: Camera) -> Float:
    """Opacity (H·W,) of the chosen surfels (N,) bool in a view; all other surfels occlude them."""
    own, background = scene.surfels.detach(), scene.surroundings
    tables = [own] if background is None else [own, background.surfels.detach()]
    feature = upload(np.pad(chosen.astype(np.float32), (0, surfel_count(tables) - own.count)))

    def blended(part: Camera) -> Float:
        return splat(tables, [feature], part).features[0]

    with dr.suspend_grad():
        return in_passes(blended, camera, surfels=surfel_count(tables))
