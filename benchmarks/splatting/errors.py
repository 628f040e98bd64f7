"""Errors of pictures and gradients against the float64 oracle, on a part of the view."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import numpy as np

from benchmarks.splatting import raster
from benchmarks.splatting.ours import Ours
from benchmarks.splatting.workload import FEATURES, Workload
from mi_refgs.constants import tile_size
from mi_refgs.reference import splat as oracle
from mi_refgs.reference.blend import differentiate
from mi_refgs.splat import list_by_tile, project
from mi_refgs.surfels.table import Surfels

PARAMETERS = ("position", "rotation", "scale", "opacity", "features")


def crop(workload: Workload, size: int) -> Workload:
    """The same surfels in a part of the view, a third from its left and upper edge; tiles stay in place."""
    p = workload.pinhole
    size = min(size, p.width, p.height)
    tile = tile_size(abs(p.fx))
    left, top = (step * (edge // 3 // step) for step, edge in zip(tile, (p.width, p.height), strict=True))
    part = replace(p, width=size, height=size, cx=p.cx - left, cy=p.cy - top)
    return replace(workload, pinhole=part)


def compare(workload: Workload, size: int) -> dict[str, float]:
    """Errors of the part; the oracle blends in our order, whose own error is `order`.

    order        largest relative depth difference of two surfels in the wrong order where they show
    left_out     share of the pixels in the oracle's declared band, which no error counts
    image_…      absolute errors of features and alpha, between 0 and 1; raster_…: of the NumPy rasteriser
    gradient_…   ‖g - g₆₄‖ / ‖g₆₄‖ of each class of parameters
    """
    part = crop(workload, size)
    p = part.pinhole
    near = _reaching(part)
    raw = {name: values[near].astype(np.float64) for name, values in part.raw.items()}
    features = part.features[near].astype(np.float64)
    ours = Ours.of(part, FEATURES)
    order = _order(ours, near, p)
    keep = np.logical_not(oracle.splat(raw, features[:, :1], p).band.ravel())
    weights = np.where(keep, part.weights(FEATURES + 2), 0).astype(np.float32)
    truth = differentiate(raw, features, p, weights.astype(np.float64), order)

    ours.set_weights(weights)
    out = ours.both()
    dr.eval(out)
    maps, gradients = out[: FEATURES + 2], out[FEATURES + 2 :]
    found = dict(zip(ours.raw, (gradient.numpy() for gradient in gradients), strict=False))
    found["features"] = np.stack([gradient.numpy() for gradient in gradients[len(ours.raw) :]], axis=1)
    shown = [*range(FEATURES), FEATURES + 1]  # all but depth, which has another scale
    image = np.abs(np.stack([maps[i].numpy() for i in shown], axis=1) - truth.maps[:, shown])[keep]
    plain = np.abs(raster.forward(part, FEATURES).reshape(-1, FEATURES + 2) - truth.maps)
    return {
        "order": _inversion(raw, p, order, truth.shown),
        "left_out": float(1 - keep.mean()),
        "image_median": float(np.median(image)),
        "image_q99": float(np.quantile(image, 0.99)),
        "image_max": float(image.max()),
        "raster_image_median": float(np.median(plain[keep][:, shown])),
    } | {f"gradient_{name}": _relative(found[name][near], truth.gradients[name]) for name in PARAMETERS}


def _relative(got: np.ndarray, expected: np.ndarray) -> float:
    return float(np.linalg.norm(got - expected)) / max(float(np.linalg.norm(expected)), 1e-30)


def part_of(size: tuple[int, int], x: int, y: int) -> tuple[slice, slice]:
    """Rows and columns of the pixels of a tile."""
    return slice(size[1] * y, size[1] * (y + 1)), slice(size[0] * x, size[0] * (x + 1))


def _reaching(workload: Workload) -> np.ndarray:
    """Indices of the surfels that may touch the picture, in the order of the table."""
    p = workload.pinhole
    _, placed, radius = raster.project(workload.raw, p)
    inside = radius >= 0
    for column, edge in ((1, p.width), (2, p.height)):
        inside &= np.abs(placed[:, column] - edge / 2) <= radius + edge / 2 + 1
    return np.nonzero(inside)[0]


def _order(ours: Ours, near: np.ndarray, p: oracle.PinholeCamera) -> np.ndarray:
    """Our order (n, H·W) of the surfels `near` at each pixel; those that its tile does not list come last."""
    lists = list_by_tile(project(Surfels(ours.raw), ours.camera), ours.camera)
    pairs, begin, end = (
        np.array(x).astype(int) for x in (lists.surfel_from_pair, lists.pair_begin, lists.pair_end)
    )
    order = np.empty((len(near), p.height, p.width), int)
    for y in range(lists.tiles_y):
        for x in range(lists.tiles_x):
            tile = y * lists.tiles_x + x
            listed = np.searchsorted(near, pairs[begin[tile] : end[tile]])
            rest = np.setdiff1d(np.arange(len(near)), listed)
            rows = np.concatenate([listed, rest])
            order[:, *part_of(ours.camera.tile, x, y)] = rows[:, None, None]
    return order.reshape(len(near), -1)


def _inversion(
    raw: dict[str, np.ndarray], p: oracle.PinholeCamera, order: np.ndarray, shown: np.ndarray
) -> float:
    """Largest relative difference of depths in the wrong order, among the surfels that a tile shows."""
    slopes, placed, _ = raster.project(raw, p)
    order, shown = order.reshape(-1, p.height, p.width), shown.reshape(-1, p.height, p.width)
    worst = 0.0
    width, height = size = tile_size(abs(p.fx))
    for y in range(-(-p.height // height)):
        for x in range(-(-p.width // width)):
            seen = np.any(shown[:, *part_of(size, x, y)], axis=(1, 2))
            rows = order[:, y * height, x * width]
            rows = rows[seen[rows]]
            middle = np.array([(x + 0.5) * width, (y + 0.5) * height])
            depth = raster.depth_near(slopes[rows], placed[rows], middle)
            late: np.ndarray = np.maximum.accumulate(depth) - depth
            worst = max(worst, float(np.max(late / depth, initial=0)))
    return worst
