"""A plain NumPy float32 rasteriser of the same footprints, lists and order: the floor that anyone can write.

It works tile by tile on (pairs, pixels) matrices; products along the list replace the loop over surfels.
"""

from __future__ import annotations

import numpy as np

from benchmarks.splatting.workload import Workload
from mi_refgs import constants as c
from mi_refgs.reference.pinhole import PinholeCamera, rotation_matrix

Array = np.ndarray


def project(raw: dict[str, Array], p: PinholeCamera) -> tuple[Array, Array, Array]:
    """Columns a b c (N, 6), k x y opacity (N, 4) as the product's footprints have them; radius (N,).

    All in the precision of the raw channels. The radius in pixels is that of a ball around the surfel, so its
    square holds the product's rectangle.
    """
    kind = raw["position"].dtype
    to_camera = p.to_world[:3, :3].T.astype(kind)
    origin = p.to_world[:3, 3].astype(kind)
    centre = (raw["position"] - origin) @ to_camera.T
    axes = np.stack([to_camera @ rotation_matrix(q).astype(kind) for q in raw["rotation"]])
    scale = np.exp(raw["scale"])
    opacity = 1 / (1 + np.exp(-raw["opacity"][:, 0]))
    t_u, t_v, n = axes[:, :, 0], axes[:, :, 1], axes[:, :, 2]
    pn = np.sum(centre * n, axis=1)
    shown = (centre[:, 2] > p.near) & (opacity >= c.ALPHA_MIN)
    shown &= np.abs(pn) > c.EDGE_ON_COSINE * np.linalg.norm(centre, axis=1)
    plane = n / np.where(shown, pn, 1)[:, None]
    focal = np.array([p.fx, p.fy], kind)
    across = [
        (t - np.sum(centre * t, axis=1, keepdims=True) * plane) / scale[:, i : i + 1]
        for i, t in enumerate((t_u, t_v))
    ]
    slopes = np.concatenate([x[:, :2] / focal for x in (*across, plane)], axis=1)
    z = np.where(shown, centre[:, 2], 1)
    middle = focal * centre[:, :2] / z[:, None] + np.array([p.cx, p.cy], kind)
    placed = np.concatenate([1 / z[:, None], middle, opacity[:, None]], axis=1)
    sigmas = np.sqrt(np.maximum(2 * np.log(np.maximum(opacity, c.ALPHA_MIN) / c.ALPHA_MIN), 0))
    reach = sigmas * scale.max(axis=1)
    ball = np.abs(focal).max() * reach * np.linalg.norm(centre, axis=1) / (z * np.maximum(z - reach, 1e-3))
    radius = np.where(shown, np.maximum(ball, sigmas / np.sqrt(c.LOW_PASS_INV_VARIANCE)), -1)
    return slopes.astype(kind), placed.astype(kind), radius.astype(kind)


def list_by_tile(slopes: Array, placed: Array, radius: Array, p: PinholeCamera) -> tuple[Array, Array]:
    """Surfels (M,), sorted by tile and depth there, and the first pair of each tile (tiles + 1,)."""
    size = np.array(c.tile_size(abs(p.fx)))
    tiles = -(-np.array([p.width, p.height]) // size)
    first = np.clip(np.ceil(placed[:, 1:3] - radius[:, None] - 0.5), 0, None).astype(int) // size
    last = np.floor(np.minimum(placed[:, 1:3] + radius[:, None] - 0.5, [p.width - 1, p.height - 1]))
    last = last.astype(int) // size
    span = np.where((radius >= 0)[:, None], np.maximum(last - first + 1, 0), 0)
    count = span.prod(axis=1)
    surfel = np.repeat(np.arange(len(count)), count)
    place = np.arange(len(surfel)) - np.repeat(np.cumsum(count) - count, count)
    x = first[surfel, 0] + place % np.maximum(span[surfel, 0], 1)
    y = first[surfel, 1] + place // np.maximum(span[surfel, 0], 1)
    tile = y * tiles[0] + x
    middle = (size * (np.stack([x, y], axis=1) + 0.5)).astype(np.float32)
    depth = depth_near(slopes[surfel], placed[surfel], middle)
    order = np.lexsort((depth, tile))
    begin = np.searchsorted(tile[order], np.arange(tiles.prod() + 1))
    return surfel[order], begin


def depth_near(slopes: Array, placed: Array, middle: Array) -> Array:
    """Sort key of surfels (M,) in tiles with these centres, as `mi_refgs.primitives.surfel` has it."""
    k, delta = placed[:, 0], middle - placed[:, 1:3]
    u, v, w = (slopes[:, 2 * i] * delta[:, 0] + slopes[:, 2 * i + 1] * delta[:, 1] for i in range(3))
    inside = np.minimum(1, c.SORT_REACH * k / np.sqrt(np.maximum(u * u + v * v, c.NORM_FLOOR)))
    return 1 / np.maximum(k + inside * w, k / c.SORT_DEPTH_RANGE)


def forward(workload: Workload, features: int) -> Array:
    """Maps (H, W, features + 2) float32: the features', depth, alpha."""
    p = workload.pinhole
    slopes, placed, radius = project(workload.raw, p)
    surfel, begin = list_by_tile(slopes, placed, radius, p)
    values = np.concatenate(
        [workload.features[:, :features], np.zeros((workload.count, 1)), np.ones((workload.count, 1))], axis=1
    ).astype(np.float32)
    out = np.zeros((p.height, p.width, features + 2), np.float32)
    width, height = c.tile_size(abs(p.fx))
    tiles_x = -(-p.width // width)
    for tile in range(len(begin) - 1):
        rows = surfel[begin[tile] : begin[tile + 1]]
        if not len(rows):
            continue
        left, top = width * (tile % tiles_x), height * (tile // tiles_x)
        x, y = np.meshgrid(
            np.arange(left, min(left + width, p.width), dtype=np.float32) + np.float32(0.5),
            np.arange(top, min(top + height, p.height), dtype=np.float32) + np.float32(0.5),
        )
        weight, z = _weights(slopes[rows], placed[rows], x.ravel(), y.ravel(), p.near)
        image = weight.T @ values[rows]
        image[:, -2] = np.sum(weight * z, axis=0)
        out[top : top + height, left : left + width] = image.reshape(*x.shape, -1)
    return out


def _weights(slopes: Array, placed: Array, x: Array, y: Array, near: float) -> tuple[Array, Array]:
    """α T and depth (surfels, pixels) of the surfels of a tile, nearest first."""
    k, opacity = placed[:, 0:1], placed[:, 3:4]
    dx, dy = x - placed[:, 1:2], y - placed[:, 2:3]
    u, v, w = (slopes[:, 2 * i : 2 * i + 1] * dx + slopes[:, 2 * i + 1 : 2 * i + 2] * dy for i in range(3))
    inverse = k + w
    front = inverse > 0
    z = 1 / np.where(front, inverse, 1)
    plane = z * z * (u * u + v * v)
    screen = np.float32(c.LOW_PASS_INV_VARIANCE) * (dx * dx + dy * dy)
    low_pass = ~front | (screen < plane)
    z = np.where(low_pass, 1 / k, z)
    alpha = np.minimum(np.float32(c.ALPHA_MAX), opacity * np.exp(-0.5 * np.where(low_pass, screen, plane)))
    alpha = np.where((alpha >= c.ALPHA_MIN) & (z > near), alpha, 0)
    after = np.cumprod(1 - alpha, axis=0)
    # Once a surfel would take T below the limit, T without that surfel's step no longer matters: all end.
    before = np.concatenate([np.ones((1, alpha.shape[1]), np.float32), after[:-1]])
    goes_on = np.logical_and.accumulate(after >= c.TRANSMITTANCE_MIN, axis=0)
    return np.where(goes_on, before * alpha, 0), z
