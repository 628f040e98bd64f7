"""Exposure and white balance: the gains that fit a render to an image."""

import numpy as np

from mi_refgs.data.view import View
from mi_refgs.io.images import SRGB_LINEAR_LIMIT, linear_from_srgb

CLIPPED = float(linear_from_srgb(np.array(254.5 / 255)))  # linear value from which an 8-bit image is clipped
MAX_GAIN = 16.0  # gains are limited to this and its inverse, ± 4 stops: larger ones mean a failed render


def fitted_gain(
    radiance: np.ndarray,  # (H, W, 3) linear, premultiplied by `alpha`
    alpha: np.ndarray,  # (H, W)
    view: View,
    background: np.ndarray,  # (3,) of the view
    where: np.ndarray | None = None,  # (H, W) bool; pixels that count, by default all
) -> np.ndarray:
    """Gains (3,) that fit a render to the image of a view; 1 for a black channel. Per channel the least
    squares over pixels of linear object colours, weighted by coverage and the slope of the sRGB curve, so
    that errors count as displayed. Clipped pixels are left out."""
    view = view.load()
    covered = alpha if view.alpha is None else np.minimum(alpha, view.alpha)
    rendered = np.maximum(radiance, 0) / np.maximum(alpha, 1e-6)[..., None]
    colour = view.colour(background)
    brighter = np.maximum(np.maximum(rendered, colour), SRGB_LINEAR_LIMIT)
    weight = covered[..., None] * brighter ** (1 / 2.4 - 1)
    if not view.is_linear_radiance:
        weight = weight * (colour < CLIPPED)
    if where is not None:
        weight = weight * where[..., None]
    square = np.square(weight, dtype=np.float64)
    above = np.sum(square * rendered * colour, axis=(0, 1))
    below = np.sum(square * rendered * rendered, axis=(0, 1))
    lit = (above > 0) & (below > 0)
    gain = np.where(lit, above, 1) / np.where(lit, below, 1)
    return np.clip(gain, 1 / MAX_GAIN, MAX_GAIN)
