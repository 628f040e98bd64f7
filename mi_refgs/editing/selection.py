"""Which surfels an edit is of: by their values, where they are, or what a painted picture shows of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.editing.expression import parse_condition
from mi_refgs.editing.fields import Fields
from mi_refgs.errors import InputError
from mi_refgs.io.images import box_downscale, read_mask
from mi_refgs.kernels.device import upload
from mi_refgs.render.pipeline import render_depth
from mi_refgs.render.surroundings import together
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat import Camera, splat

PAINTED_SHARE = 0.5
"""Part of a surfel's blended weight that must lie in the painted pixels."""
BEHIND_SIZES = 3.0
"""Standard deviations of a surfel by which its centre may lie behind the depth that its pixels show. Of a
mirror ball of 12,000 surfels, all of it painted, 0.6 % of the far side are then selected (at 6 5 %, without a
limit 38 %), and 99.1 % of the weight that the picture blends (at 1 96.6 %, at 6 99.7 %)."""


@dataclass(frozen=True)
class Selection:
    """Surfels that meet every condition that is given; without any, all of them."""

    where: str | None = None  # an expression, see `expression` and `fields`
    box: Sequence[float] | None = None  # x0 y0 z0 x1 y1 z1: two opposite corners; centres lie inside
    nearest: Sequence[float] | None = None  # x y z r: centres within r of the surfel nearest to the point
    mask: np.ndarray | str | Path | None = None  # of a view of `camera`: see `painted`, `painted_pixels`
    camera: Camera | None = None
    invert: bool = False  # take the others instead


def select(scene: TrainedScene, selection: Selection) -> np.ndarray:
    """The selected surfels (N,) bool; raises InputError for a senseless condition, or if none is selected."""
    count = scene.surfels.count
    chosen = np.ones(count, bool)
    position = scene.surfels.to_numpy()["position"].astype(np.float64)
    if selection.where is not None:
        condition, fields = parse_condition(selection.where), Fields(scene)
        fields.check(condition.names, "--where")
        chosen &= condition.of(fields)
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
        if selection.camera is None:
            raise InputError("--mask: the view that it was painted in is missing; give its camera")
        given, camera = selection.mask, selection.camera
        mask = given if isinstance(given, np.ndarray) else painted_pixels(Path(given), camera)
        chosen &= painted(scene, camera, mask)
    chosen = ~chosen if selection.invert else chosen
    if not chosen.any():
        raise InputError(f"selection: none of the {count} surfels is in it; choose a wider one")
    return chosen


def painted(scene: TrainedScene, camera: Camera, mask: np.ndarray) -> np.ndarray:
    """The surfels (N,) bool that painted pixels, `mask` (H, W) bool, show in a view.

    More than PAINTED_SHARE of the weight that the picture blends them with lies in the mask, and they are no
    more than BEHIND_SIZES behind the depth that those pixels show, weighted in the same way: what little of a
    far side shines through is not painted. Surroundings hide the object as they do in pictures. Raises
    InputError for a mask of another size.
    """
    if mask.shape != (camera.height, camera.width):
        raise InputError(
            f"--mask: {mask.shape[1]} × {mask.shape[0]} pixels, but the view has {camera.width} × "
            f"{camera.height}; paint a picture of that view"
        )
    own, around = scene.surfels.detach(), scene.surroundings
    table = own if around is None else together(own, around.surfels.detach())
    with dr.suspend_grad():
        depth, _ = render_depth(own, camera, None if around is None else around.surfels.detach())
    weights = [upload(mask.astype(np.float32)), mi.Float(1), depth]
    # The gradient of a blended feature, times an image, is the blended weight of each row, times that image.
    features = [dr.opaque(mi.Float, 0, table.count) for _ in weights]
    for feature in features:
        dr.enable_grad(feature)
    blended = splat(table, features, camera).features
    total = dr.sum(sum(weight * image for weight, image in zip(weights, blended, strict=True)))
    if dr.grad_enabled(total):  # unless the view sees nothing
        dr.backward(total)
    inside, every, far = (np.array(dr.grad(x), np.float64)[: own.count] for x in features)
    centre = np.array(camera.to_camera(own.position()).z, np.float64)
    shown_depth = far / np.maximum(every, np.finfo(np.float64).tiny)
    behind = centre - shown_depth > BEHIND_SIZES * Fields(scene)["size"]
    return (every > 0) & (inside > PAINTED_SHARE * every) & ~behind


def painted_pixels(path: Path, camera: Camera) -> np.ndarray:
    """The painted pixels (H, W) bool of a picture of a view: white, or opaque where the rest is transparent.

    A picture whose sides are a whole number of times the view's is averaged down. Raises InputError for a
    file that is no picture, is of another size, or has nothing painted.
    """
    share = whole = read_mask(path)[..., None]
    factor = max(1, share.shape[0] // max(camera.height, 1))
    share = box_downscale(share, factor)[..., 0]
    if share.shape != (camera.height, camera.width):
        raise InputError(
            f"{path}: mask: {whole.shape[1]} × {whole.shape[0]} pixels, but the view has {camera.width} × "
            f"{camera.height}; paint a picture of that view"
        )
    mask = share > 0.5
    if not mask.any():
        raise InputError(f"{path}: mask: no pixel is painted white; paint what is meant")
    return mask


def finite(where: str, numbers: Sequence[float], count: int) -> np.ndarray:
    """Numbers (count,) float64; raises InputError, with `where` in the message, for anything else."""
    try:
        found = np.asarray(numbers, dtype=np.float64)
    except (ValueError, TypeError):
        found = np.zeros(0)
    if found.shape != (count,) or not (np.abs(found) <= MAX_NUMBER).all():
        raise InputError(f"{where}: {count} finite numbers are needed, none beyond {MAX_NUMBER:g}; give them")
    return found
