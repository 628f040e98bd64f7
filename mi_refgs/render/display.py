"""Display of linear radiance, the one place of the sRGB curve: lists of mi.Float planes (H·W)."""

from collections.abc import Iterable, Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.io.images import SRGB_LINEAR_LIMIT
from mi_refgs.render.pipeline import Frame
from mi_refgs.types import Array, Color3f, Float

ALPHA_EMPTY = 1e-6  # alpha below which a pixel is empty: only the background is seen


def srgb_from_linear(linear: Float) -> Float:
    """sRGB encoding (IEC 61966-2-1) of a linear plane, unbounded above 1; finite slope (12.92 at 0)."""
    straight = linear <= SRGB_LINEAR_LIMIT
    curve = 1.055 * dr.power(dr.select(straight, 1.0, linear), 1 / 2.4) - 0.055
    return dr.select(straight, 12.92 * linear, curve)


def display_image(radiance: Iterable[Float], alpha: Float, background: Iterable[Float]) -> list[Float]:
    """Composite as 8-bit RGBA: A srgb(L / A) + (1 - A) background per plane, L linear, premultiplied,
    `background` encoded; where A < 1e-6 the background alone."""
    seen = alpha >= ALPHA_EMPTY
    inverse = dr.select(seen, dr.rcp(dr.select(seen, alpha, 1.0)), 0.0)
    return [
        alpha * srgb_from_linear(plane * inverse) + (1 - alpha) * behind
        for plane, behind in zip(radiance, background, strict=True)
    ]


def composited(frame: Frame) -> tuple[Color3f, Float]:
    """Radiance over the frame's background, and alpha: 1 where there is a background."""
    if frame.background is None:
        return frame.radiance, frame.alpha
    return frame.radiance + (1 - frame.alpha) * frame.background, mi.Float(1)


def displayed(
    frame: Frame, background: np.ndarray, linear: bool, gain: Sequence[Any] | None = None
) -> list[Any]:
    """Display-encoded planes of a frame, whose own background replaces `background` (linear); `gain` per
    channel. Images with alpha are composited after encoding, linear data before it."""
    gain = [1.0] * 3 if gain is None else gain
    if frame.background is not None:
        return [srgb_from_linear(x * factor) for x, factor in zip(composited(frame)[0], gain, strict=True)]
    radiance = [plane * factor for plane, factor in zip(frame.radiance, gain, strict=True)]
    behind = [float(x) for x in background]
    if not linear:
        return display_image(radiance, frame.alpha, behind)
    return [srgb_from_linear(x + (1 - frame.alpha) * y) for x, y in zip(radiance, behind, strict=True)]


def image_array(array: Array, height: int, width: int) -> np.ndarray:
    """Convert an array of H*W pixels to (H, W), one of colours or vectors to (H, W, 3), float32."""
    if isinstance(array, list) or dr.depth_v(array) > 1:
        return np.stack([image_array(part, height, width) for part in array], axis=-1)
    return np.broadcast_to(np.array(array, dtype=np.float32).ravel(), height * width).reshape(height, width)
