"""Score relit images against ground truth: as they are, and after one scale per channel.

The light and the albedo of a fit share an unknown per-channel scale; under another light it appears as a
wrong brightness or tint of everything. So both numbers are given.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from mi_refgs.evaluation import metrics
from mi_refgs.evaluation.images import displayed_over, encoded_over_black

SCALE_REACH = 2.0  # stops around the ratio of the means within which the scale is searched
INSIDE = 0.99  # alpha from which a pixel is inside the object: the coverage of edges does not depend on light
SCALE_PIXELS = 200_000  # maximum number of pixels that the scale is fitted to


def common_scale(ours: Sequence[np.ndarray], truth: Sequence[np.ndarray]) -> np.ndarray:
    """Fit the scale of radiance per channel (3,) that minimises the error of displayed images.

    One for all images, by least squares of displayed colours inside the object.
    (Least squares of radiance would fit lamps alone.) 1 for a channel that is black in either.
    """
    a, b = (np.concatenate([p.reshape(-1, 4) for p in images]).astype(np.float64) for images in (ours, truth))
    inside = np.flatnonzero(np.minimum(a[:, 3], b[:, 3]) > INSIDE)
    chosen = inside[:: max(1, len(inside) // SCALE_PIXELS)]
    a, b = a[chosen], b[chosen]
    scale = np.ones(3)
    for c in range(3):
        goal, mean = encoded_over_black(b[:, c], b[:, 3]), (a[:, c].sum(), b[:, c].sum())
        if min(mean) <= 0:
            continue

        def error(stops: float, c: int = c, goal: np.ndarray = goal) -> float:
            return float(np.mean((encoded_over_black(a[:, c] * 2**stops, a[:, 3]) - goal) ** 2))

        middle = float(np.log2(mean[1] / mean[0]))
        found = minimize_scalar(error, bounds=(middle - SCALE_REACH, middle + SCALE_REACH))
        scale[c] = 2.0 ** min((0.0, middle, float(found.x)), key=error)
    return scale


def score(
    names: Sequence[str], ours: Sequence[np.ndarray], truth: Sequence[np.ndarray], background: np.ndarray
) -> dict[str, Any]:
    """Return `psnr`, `ssim` and both after `scale` (`…_scaled`): means over images; and `views`.

    Images are premultiplied linear RGBA (H, W, 4), compared display-encoded over the background.
    """
    scale = common_scale(ours, truth)
    views = []
    for name, own, true in zip(names, ours, truth, strict=True):
        goal = displayed_over(true, background)
        plain, scaled = displayed_over(own, background), displayed_over(own, background, scale)
        found: dict[str, Any] = {"name": name}
        for key, measure in (("psnr", metrics.psnr), ("ssim", metrics.ssim)):
            found |= {key: measure(plain, goal), f"{key}_scaled": measure(scaled, goal)}
        views.append(found)
    means = {k: float(np.mean([v[k] for v in views])) for k in views[0] if k != "name"}
    return means | {"scale": [float(x) for x in scale], "views": views}
