"""Displayed images of a fit as NumPy arrays, their errors, and the gains and poses that make them smaller."""

import math
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset
from mi_refgs.data.exposure import fitted_gain
from mi_refgs.data.registration import registered
from mi_refgs.data.view import View
from mi_refgs.io.images import blocks_within
from mi_refgs.render.display import composited, displayed, image_array
from mi_refgs.render.pipeline import Frame
from mi_refgs.render.samples import supersampled
from mi_refgs.splat import Camera

REGISTERED = 128 * 128  # pixels to which the image of a registered view is averaged, at most


def displayed_image(frame: Frame, view: View, data: Dataset, gain: np.ndarray | None = None) -> np.ndarray:
    """Display-encoded image (H, W, 3) of a rendered view; `gain` (3,) per channel."""
    factors = None if gain is None else [dr.opaque(mi.Float, float(g)) for g in gain]
    planes = displayed(frame, data.background, data.is_linear_radiance, factors)
    return image_array(planes, view.height, view.width)


def with_gain(
    frame: Frame, view: View, data: Dataset, where: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The `fitted_gain` (3,) of a rendered view, `where` as there; its image (H, W, 3) with that gain."""
    rendered, alpha = (image_array(planes, view.height, view.width) for planes in composited(frame))
    gain = fitted_gain(rendered, alpha, view, data.background, where)
    return gain, displayed_image(frame, view, data, gain)


def aligned(
    view: View, frame: Frame, render: Callable[[Camera], Frame], data: Dataset, where: np.ndarray
) -> View:
    """A loaded view with the pose that fits its pixels `where` (H, W) best; `frame` has the present one."""
    gain, before = with_gain(frame, view, data, where)
    block = math.ceil(math.sqrt(view.width * view.height / REGISTERED))

    def image_of(moved: View) -> np.ndarray:
        # One sample per pixel of an averaged image aliases: poses were half a pixel off.
        samples = 4 if moved.width < view.width else 1
        return displayed_image(supersampled(render, moved.camera(), samples, maps=False), moved, data, gain)

    found = registered(view.averaged(block), image_of, data.scene_extent, blocks_within(where, block))
    moved = replace(view, to_world=found.to_world)
    errors = [squared_error(image, view)[where].mean() for image in (before, image_of(moved))]
    return moved if errors[1] < errors[0] else view


def squared_error(image: np.ndarray, view: View) -> np.ndarray:
    """Squared error (H, W, 3) of a display-encoded image (H, W, 3) of a view, both clipped to [0, 1]."""
    return np.square(np.clip(image, 0, 1) - np.clip(view.load().displayed, 0, 1))
