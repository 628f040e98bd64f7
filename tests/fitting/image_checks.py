"""Helpers of the loss tests: planes, differences of a float64 definition, and one check of both modes."""

from collections.abc import Callable
from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.data.dataset import View
from mi_refgs.data.images import Pixels
from mi_refgs.kernels.device import upload
from mi_refgs.reference import losses as reference
from tests.helpers import with_grad

HEIGHT, WIDTH = 14, 17  # not square, and larger than SSIM's window in one axis only by a little
BACKGROUND = np.array([1.0, 0.5, 0.25], np.float32)
STEP = 1e-5  # of the float64 definitions: truncation 1e-10, rounding 1e-11
VALUE = 2e-6  # float32 sums of 700 numbers of size 1: observed 3e-7
GRADIENT = 2e-5  # relative L2 against float64 differences: observed 1e-6 (SSIM 4e-6)


def picture(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Premultiplied radiance that a gain may take beyond white, and alpha with empty and full pixels."""
    alpha = np.clip(rng.uniform(-0.5, 1.5, (HEIGHT, WIDTH)), 0, 1)
    return rng.uniform(0.01, 0.9, (HEIGHT, WIDTH, 3)) * alpha[..., None], alpha


def planes(image: np.ndarray) -> list[Any]:
    """(H, W, 3) array → three planes."""
    return [upload(image[..., c]) for c in range(image.shape[2])]


def shown(radiance: np.ndarray, alpha: np.ndarray, linear: bool, gain: Any = 1.0) -> np.ndarray:
    """The image of exposed premultiplied radiance, in float64, as its file has it."""
    if linear:
        return np.asarray(radiance * gain + (1 - alpha[..., None]) * BACKGROUND)
    x, y, z = map(float, BACKGROUND)
    return reference.display_image(radiance * gain, alpha, (x, y, z))


def view_of(image: np.ndarray, alpha: np.ndarray | None, linear: bool) -> View:
    image = image.astype(np.float32)
    alpha = None if alpha is None else alpha.astype(np.float32)
    pixels = Pixels(image, alpha)
    return View("a", WIDTH, HEIGHT, 20.0, 20.0, 8.0, 7.0, np.eye(4), pixels, is_linear_radiance=linear)


def stack(planes_: list[Any]) -> np.ndarray:
    slopes = [np.array(dr.grad(p), dtype=np.float64) for p in planes_]
    return np.stack(slopes, axis=-1).reshape(HEIGHT, WIDTH, -1)


def gradient(
    function: Callable[[np.ndarray], float], at: np.ndarray, entries: np.ndarray | None = None
) -> np.ndarray:
    """Central differences of a float64 function, for all entries or those of a mask."""
    slope = np.zeros(at.shape)
    for index in zip(*np.nonzero(np.ones(at.shape, bool) if entries is None else entries), strict=True):
        shifted = at.copy()
        shifted[index] = at[index] + STEP
        above = function(shifted)
        shifted[index] = at[index] - STEP
        slope[index] = (above - function(shifted)) / (2 * STEP)
    return slope


def check(
    loss: Callable[[list[Any]], Any],
    define: Callable[[np.ndarray], float],
    image: np.ndarray,
    share: float = 1.0,
    tolerance: float = GRADIENT,
) -> None:
    """Value, reverse-mode gradient and one forward-mode directional derivative of a loss of an image.

    share: of the entries that are compared one by one (slow definitions); the image's rim is always among
    them. tolerance: relative L2."""
    image = image.astype(np.float32).astype(np.float64)
    leaves = with_grad(planes(image))
    value = loss(leaves)
    assert abs(float(value[0]) - define(image)) < VALUE
    dr.backward(value)
    entries = np.random.default_rng(2).random(image.shape) < share
    entries[0, :2] = entries[-1, -2:] = True
    found, wanted = stack(leaves), gradient(define, image, entries)
    assert np.linalg.norm(wanted) > 0
    assert np.linalg.norm((found - wanted)[entries]) <= tolerance * np.linalg.norm(wanted)

    direction = np.random.default_rng(3).normal(size=image.shape).astype(np.float32)
    value = loss(with_grad(planes(image), planes(direction)))
    dr.forward_to(value)
    towards = direction.astype(np.float64)
    expected = (define(image + STEP * towards) - define(image - STEP * towards)) / (2 * STEP)
    scale = np.linalg.norm(found) * np.linalg.norm(direction)
    assert abs(float(dr.grad(value)[0]) - expected) <= tolerance * scale
