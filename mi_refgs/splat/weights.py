"""Blending weights of surfels: how much of an image each one is responsible for."""

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.splat import list_by_tile, project, splat
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.composite import inverse_alpha
from mi_refgs.surfels.table import Surfels
from mi_refgs.types import Float


def blended_weights(
    surfels: Sequence[Surfels], camera: Camera, maps: Sequence[Float | float] = (1.0,), depth: bool = False
) -> list[np.ndarray]:
    """Sums Σ w m (N,) float64 of blending weights, for each map m (H·W,): gradients of Σ m Σ w f by f. A map
    of 1 gives pixels; with `depth`, the last one is the expected depth of the view."""
    count = sum(table.count for table in surfels)
    features = [dr.opaque(mi.Float, 0, count) for _ in range(len(maps) + depth)]
    dr.enable_grad(features)
    blended = splat([table.detach() for table in surfels], features, camera)
    if depth:
        maps = [*maps, dr.detach(blended.depth * inverse_alpha(blended.alpha))]
    total = dr.sum(sum(m * image for m, image in zip(maps, blended.features, strict=True)))
    if dr.grad_enabled(total):  # unless the view shows nothing
        dr.backward(total)
    return [np.array(dr.grad(feature), dtype=np.float64) for feature in features]


def listed_tiles(surfels: Sequence[Surfels], camera: Camera) -> np.ndarray:
    """Tiles (N,) of an image in whose lists each of N surfels is: what it costs, wherever it is hidden."""
    with dr.suspend_grad():
        lists = list_by_tile(project(surfels, camera), camera)
    return np.bincount(np.array(lists.surfel_from_pair), minlength=sum(table.count for table in surfels))
