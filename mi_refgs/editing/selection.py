"""Selection of surfels by their values, their positions, or a mask painted on an image."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.editing.expression import SurfelValues, parse_condition
from mi_refgs.editing.options import Selection
from mi_refgs.errors import InputError
from mi_refgs.io.images import box_downscale, read_mask
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


def select(
    scene: TrainedScene,
    selection: Selection,
    camera: Camera | None = None,  # of the view that the mask belongs to
) -> np.ndarray:
    """Return the selected surfels (N,) bool; raises InputError for bad conditions, or if none is selected."""
    count = scene.surfels.count
    chosen = np.ones(count, bool)
    position = scene.surfels.to_numpy()["position"].astype(np.float64)
    if selection.where is not None:
        condition, values = parse_condition(selection.where), SurfelValues(scene)
        values.require(condition.names, "--where")
        chosen &= condition.evaluate(values)
    if selection.box is not None:
        corners = finite("--box", selection.box, 6).reshape(2, 3)
        chosen &= np.all((position >= corners.min(0)) & (position <= corners.max(0)), axis=1)
    if selection.nearest is not None and count:
        *point, radius = finite("--nearest", selection.nearest, 4)
        if radius < 0:
            raise InputError(f"--nearest: the distance {radius:g} is negative; give one from 0")
        middle = position[np.argmin(np.linalg.norm(position - point, axis=1))]
        chosen &= np.linalg.norm(position - middle, axis=1) <= radius
    if selection.mask is not None:
        given = selection.mask
        if camera is None:
            raise InputError("--mask: the view that it was painted in is missing; give its camera")
        mask = given if isinstance(given, np.ndarray) else read_painted(Path(given), camera)
        chosen &= painted(scene, camera, mask)
    chosen = ~chosen if selection.invert else chosen
    if not chosen.any():
        raise InputError(f"selection: none of the {count} surfels is in it; choose a wider one")
    return chosen


def painted(scene: TrainedScene, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """Return the surfels (N,) bool that painted pixels, `mask` (H, W) bool, show in a view.

    More than PAINTED_SHARE of a surfel's `shown_weights` lies in the mask. Raises InputError for a mask of
    another size.
    """
    every, inside = shown_weights(scene, camera, mask)
    return inside > PAINTED_SHARE * every


def shown_weights(scene: TrainedScene, camera: Camera, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the blended weight of each surfel in a view, and that in painted pixels: (N,), pixels.

    It is 0 if the centre is more than BEHIND_SIZES behind the mean depth of the surfel's pixels, so that a
    far side that shines through is left out. The background occludes the object. Raises InputError for a
    mask of another size.
    """
    _require_size("--mask", mask, camera)
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


def read_painted(path: Path, camera: Camera) -> np.ndarray:
    """Return the painted pixels (H, W) bool of an image of a view: white, or opaque on transparent.

    An image that is larger than the view by a whole factor is averaged down. Raises InputError for a file
    that is no image, has another size, or has nothing painted.
    """
    whole = read_mask(path)
    share = box_downscale(whole[..., None], max(1, whole.shape[0] // max(camera.height, 1)))[..., 0]
    if share.shape != (camera.height, camera.width):
        _require_size(f"{path}: mask", whole, camera)
    mask = share > 0.5
    if not mask.any():
        raise InputError(f"{path}: mask: no pixel is painted white; paint what is meant")
    return mask


def _require_size(where: str, mask: np.ndarray, camera: Camera) -> None:
    """Raise InputError unless a mask has the size of its view."""
    if mask.shape != (camera.height, camera.width):
        raise InputError(
            f"{where}: {mask.shape[1]} × {mask.shape[0]} pixels, but the view has {camera.width} × "
            f"{camera.height}; paint an image of that view"
        )


def finite(where: str, numbers: Sequence[float], count: int) -> np.ndarray:
    """Return numbers (count,) float64; raises InputError, with `where` in the message, for anything else."""
    try:
        found = np.asarray(numbers, dtype=np.float64)
    except (ValueError, TypeError):
        found = np.zeros(0)
    if found.shape != (count,) or not (np.abs(found) <= MAX_NUMBER).all():
        raise InputError(f"{where}: {count} finite numbers are needed, none beyond {MAX_NUMBER:g}; give them")
    return found
