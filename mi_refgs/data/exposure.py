"""Exposure and white balance of pictures: what EXIF says, and gains that fit a render to a picture."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from mi_refgs.data.view import View
from mi_refgs.io.images import SRGB_LINEAR_LIMIT, exif_tags, linear_from_srgb, open_picture

EXPOSURE_TIME, F_NUMBER, ISO = 33434, 33437, 34855
"""Tags of EXIF 2.3 in the table of the camera's settings: seconds, the f-number, and the sensitivity."""
CLIPPED = float(linear_from_srgb(np.array(254.5 / 255)))
"""Linear value from which an 8-bit picture says only "at least this bright"."""
MAX_GAIN = 16.0
"""Gains lie between this and its inverse, 4 stops either way: more is no exposure but a failed render."""


def log_exposure(path: Path) -> float | None:
    """log(time · ISO / f-number²) from the EXIF data of a picture; None where it does not say all three.

    The values of a sensor are proportional to its exponential. Raises InputError for a file that is no
    picture.
    """
    if path.suffix.lower() == ".exr":
        return None
    with open_picture(path) as picture:
        _, settings = exif_tags(picture)
    try:
        sensitivity = settings[ISO]
        iso = sensitivity[0] if isinstance(sensitivity, tuple) else sensitivity
        exposure = float(settings[EXPOSURE_TIME]) * float(iso) / float(settings[F_NUMBER]) ** 2
    except (KeyError, IndexError, TypeError, ValueError, ArithmeticError):  # missing, or nonsense
        return None
    return math.log(exposure) if 0 < exposure < math.inf else None


def fitted_gain(
    radiance: np.ndarray,
    alpha: np.ndarray,
    view: View,
    background: np.ndarray,
    where: np.ndarray | None = None,
) -> np.ndarray:
    """Gains (3,) of linear `radiance` (H, W, 3), premultiplied by `alpha` (H, W), that bring it to a picture.

    Per channel the least squares of g L - T over pixels, L and T the linear colours of the object in render
    and picture, each pixel weighted by its coverage in both and by the slope of the sRGB curve: so errors
    count as they are seen. Pixels where an 8-bit picture is clipped do not count, nor those not in `where`
    (H, W, bool). A channel without light has gain 1.
    """
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
