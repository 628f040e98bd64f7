"""The roughness of a whole pixel, from its neighbours' normals, in loops."""

from __future__ import annotations

import numpy as np


def widened(roughness: np.ndarray, normal: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Maps (H, W), (H, W, 3), (H, W); as `render.antialias.widened`."""
    height, width = alpha.shape
    out = np.array(roughness, np.float64)
    for y in range(height):
        for x in range(width):
            if alpha[y, x] <= 1e-3:
                continue
            own = normal[y, x] / np.linalg.norm(normal[y, x])
            total = 0.0
            for steps in (((-1, 0), (1, 0)), ((0, -1), (0, 1))):
                turns = []
                for dx, dy in steps:
                    i, j = x + dx, y + dy
                    if 0 <= i < width and 0 <= j < height and alpha[j, i] > 1e-3:
                        other = normal[j, i] / np.linalg.norm(normal[j, i])
                        turns.append(float(np.sum((own - other) ** 2)))
                total += min(turns, default=0.0)
            out[y, x] = min(roughness[y, x] ** 4 + min(total / 12, 0.18), 1.0) ** 0.25
    return out
