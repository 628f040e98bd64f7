"""Displayed images of a fit as NumPy arrays, and their errors."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import fitted_gain
from mi_refgs.data.view import View
from mi_refgs.io.images import psnr_of
from mi_refgs.render.display import displayed
from mi_refgs.render.pipeline import Frame
from mi_refgs.types import Float


def image_of(planes: list[Float], view: View) -> np.ndarray:
    """Planes of a frame as an image (H, W, C)."""
    values = [np.broadcast_to(np.array(plane), view.height * view.width) for plane in planes]
    return np.stack(values, axis=-1).reshape(view.height, view.width, -1)


def displayed_of(frame: Frame, data: Dataset, gain: np.ndarray | None = None) -> list[Float]:
    """`displayed` with an opaque gain."""
    factors = None if gain is None else [dr.opaque(mi.Float, float(g)) for g in gain]
    return displayed(frame, data.background, data.is_linear_radiance, factors)


def with_gain(frame: Frame, view: View, data: Dataset) -> tuple[np.ndarray, np.ndarray]:
    """The `fitted_gain` (3,) of a rendered view, and its image (H, W, 3) with that gain."""
    planes, alpha = list(frame.radiance), image_of([frame.alpha], view)[..., 0]
    if frame.background is not None:  # the image is opaque
        planes = [a + (1 - frame.alpha) * b for a, b in zip(planes, frame.background, strict=True)]
        alpha = np.ones_like(alpha)
    gain = fitted_gain(image_of(planes, view), alpha, view, data.background)
    return gain, image_of(displayed_of(frame, data, gain), view)


def squared_error(image: np.ndarray, view: View) -> np.ndarray:
    """Squared error (H, W, 3) of a display-encoded image (H, W, 3) of a view, both clipped to [0, 1]."""
    return np.square(np.clip(image, 0, 1) - np.clip(view.load().displayed, 0, 1))


def psnr(image: np.ndarray, view: View) -> float:
    """PSNR (dB) of a display-encoded image (H, W, 3) of a view."""
    return psnr_of(float(squared_error(image, view).mean()))
