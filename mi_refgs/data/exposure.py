"""Exposure and white balance: what photographs tell of them, and the gains that fit a render to an image."""

from collections.abc import Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.linalg import lsqr

from mi_refgs.data.view import View
from mi_refgs.io.images import SATURATED, SRGB_LINEAR_LIMIT, exif_tags, linear_from_srgb, open_image, positive

EXIF_EXPOSURE = {0x829A: 1, 0x8827: 1, 0x829D: -2}  # time, sensitivity, f-number; powers in a gain
SET, SEEN = 0.05, 0.15  # least log gain in EXIF; least deviation of those of points: gloss feigns up to 0.1
KEYPOINTS = 20  # of a view that are neither dark nor clipped, from which its gain is more than chance
DARK, BRIGHT = 0.05, 0.95  # encoded values between which noise and clipping do not matter
OUTLIER = 0.02  # log residual from which a point counts by its sign only, nearly
CLIPPED = float(linear_from_srgb(np.array(SATURATED)))  # linear value from which an 8-bit image is clipped
MAX_GAIN = 16.0  # gains are limited to this and its inverse, ± 4 stops: larger ones mean a failed render


def told_gains(views: Sequence[View]) -> np.ndarray | None:
    """Log gains (V, 3) of mean 0 by what photographs tell before a fit: EXIF data, unless colours of points
    that several views show contradict them, else these colours; None for one exposure, or if nobody knows."""
    written, seen = _of_settings(views), _of_points(views)
    if written is not None and abs(written).max() >= SET:
        if seen is None or (seen - written).std() < seen.std():
            return written
    return seen if seen is not None and seen.std() >= SEEN else None


def _of_settings(views: Sequence[View]) -> np.ndarray | None:
    settings = np.full((len(views), len(EXIF_EXPOSURE)), np.nan)
    for i, view in enumerate(views):
        if view.file is None or view.is_linear_radiance:
            return None
        with open_image(view.file.path) as image:
            found = exif_tags(image)[1]
        settings[i] = [positive(found.get(tag)) or np.nan for tag in EXIF_EXPOSURE]
    if np.isnan(settings[:, 2]).all():  # a lens without contacts; its aperture seldom changes
        settings[:, 2] = 1
    log = np.log(settings) @ list(EXIF_EXPOSURE.values())
    return None if np.isnan(log).any() else np.repeat(log[:, None] - log.mean(), 3, axis=1)


def _of_points(views: Sequence[View]) -> np.ndarray | None:
    """Least absolute residuals of log colour = log gain + that of the point, by weighted least squares."""
    tracks = [view.tracks for view in views if view.tracks is not None and len(view.tracks) >= KEYPOINTS]
    if len(tracks) < len(views):
        return None
    own = np.repeat(np.arange(len(views)), [len(track) for track in tracks])
    points = np.unique(np.concatenate(tracks)[:, 2:], axis=0, return_inverse=True)[1].ravel()
    colours, gains = np.concatenate([*map(_colours, views, tracks)]), []
    for encoded in colours.T:
        usable = np.flatnonzero((encoded > DARK) & (encoded < BRIGHT))
        if np.bincount(own[usable], minlength=len(views)).min() < KEYPOINTS:
            return None
        log, row = np.log(linear_from_srgb(encoded[usable])), np.tile(np.arange(len(usable)), 2)
        column = np.concatenate([own[usable], len(views) + points[usable]])
        shape = len(usable), len(views) + points.max() + 1
        system, found, left = csr_array((np.ones(len(row)), (row, column)), shape), np.zeros(shape[1]), log
        for _ in range(10):  # the first time all count about equally
            weight = np.maximum(abs(left), OUTLIER) ** -0.5
            found += lsqr(system * weight[:, None], left * weight, iter_lim=60)[0]
            left = log - system @ found
        gains.append(found[: len(views)] - found[: len(views)].mean())
    return np.stack(gains, axis=1)


def _colours(view: View, track: np.ndarray) -> np.ndarray:
    """Encoded colours (K, 3) of the points of a view; 0 where it does not show them."""
    (row, column, shown), last = view.project(track[:, 2:]), (view.height - 1, view.width - 1)
    at = (np.clip(np.round(x), 0, most).astype(int) for x, most in zip((row, column), last, strict=True))
    return np.where(shown[:, None], view.load().displayed[*at], 0)


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
    return np.clip(np.where(lit, above, 1) / np.where(lit, below, 1), 1 / MAX_GAIN, MAX_GAIN)
