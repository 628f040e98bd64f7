"""Rows of neighbours next to each other in the table: what a tile reads is then close together in memory."""

from __future__ import annotations

import numpy as np

BITS = 10
"""Cells along an axis, log₂: finer than the surfels of any scene lie."""

OUTLIERS = 0.01
"""Share of points along an axis, at either end, that the cells leave out: they go to the outermost ones."""


def morton_order(points: np.ndarray) -> np.ndarray:
    """Order (N,) in which points (N, 3) lie along a Z-shaped space-filling curve; stable. [Morton 1966]"""
    if len(points) == 0:
        return np.zeros(0, dtype=np.int64)
    low, high = np.quantile(points, (OUTLIERS, 1 - OUTLIERS), axis=0)
    edge = max(float((high - low).max()), np.finfo(np.float32).tiny)
    cell = np.clip((points - low) / edge * 2**BITS, 0, 2**BITS - 1).astype(np.uint32)
    place = np.zeros(len(points), dtype=np.uint32)
    for bit in range(BITS):
        for axis in range(3):
            place |= (cell[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(place, kind="stable")
