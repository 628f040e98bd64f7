"""What a step lowers: the loss of one rendered view against its picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_refgs.data.dataset import Dataset, View
from mi_refgs.fitting import losses
from mi_refgs.kernels.device import upload
from mi_refgs.methods.weights import LossWeights
from mi_refgs.render.depth_normals import normals_from_depth
from mi_refgs.render.display import displayed, srgb_from_linear
from mi_refgs.render.pipeline import Frame
from mi_refgs.splat import Camera

MATERIALS = ("roughness", "metallic")
"""Maps that neighbours of like colour share."""
MATERIAL_EDGE = 10.0
"""Steepness of edges that are kept: a step of 0.1 in the picture from a pixel to the next counts a third."""

GAIN_PRIOR = 1e-3
"""Weight of the squared log gains: two stops cost as much as 0.6 % of brightness, so it decides only where a
picture tells nothing, such as a channel without light."""


@dataclass(frozen=True)
class Target:
    """A view on the device: camera and planes of H·W values."""

    camera: Camera
    image: list[Any]  # display-encoded
    clipped: list[Any] | None  # where an 8-bit target says only "at least this bright"
    alpha: Any | None

    @staticmethod
    def of(view: View, background: np.ndarray) -> Target:
        """Upload a view; `background` (3,) in the space of its picture."""
        loaded = view.load()
        colour, opacity = loaded.image, loaded.alpha
        planes = [upload(colour[..., i]) for i in range(3)]
        image = [srgb_from_linear(plane) for plane in planes] if view.is_linear_radiance else planes
        alpha = None if opacity is None else upload(opacity)
        clipped = None if view.is_linear_radiance else losses.saturated(image, alpha, map(float, background))
        target = Target(view.camera(), image, clipped, alpha)
        dr.eval(target.image, target.clipped, target.alpha)
        return target


def objective(
    frame: Frame,
    target: Target,
    data: Dataset,
    weights: LossWeights,
    iteration: int,
    light: Any = None,
    log_gain: list[Any] | None = None,
) -> tuple[Any, Any]:
    """Weighted sum of the losses of a frame (mi.Float of width 1), and its mean squared error, detached.

    The terms are those of `LossWeights`, weighted as it says for this iteration; see `render.display`.
    `light` is the light of the step, under AD; without it there is no prior on its colour.
    `log_gain`, three mi.Float of width 1, is the exposure of the picture; without it, that is 0.
    """
    width, height = target.camera.width, target.camera.height
    gain = None if log_gain is None else [dr.exp(value) for value in log_gain]
    image = displayed(frame, data.background, data.is_linear_radiance, gain)
    if target.clipped is not None:
        image = losses.clip_highlights(image, target.image, target.clipped)
    loss = (1 - weights.ssim) * losses.l1(image, target.image)
    if log_gain is not None:
        loss += GAIN_PRIOR * sum((dr.square(value) for value in log_gain), mi.Float(0))
    if weights.ssim:
        loss += weights.ssim * losses.d_ssim(image, target.image, width, height)
    if weights.normal and iteration > weights.normal_start:
        weight = _risen(weights.normal, iteration - weights.normal_start, weights.normal_rise)
        depth_normal, valid = normals_from_depth(frame.depth, frame.alpha, target.camera)
        loss += weight * losses.normal_consistency(frame.normal, depth_normal, valid, frame.normal_alpha)
    if weights.smooth and iteration <= weights.smooth_until:
        loss += weights.smooth * losses.smoothness(list(frame.normal), target.image, width, height)
    if weights.half_metal and "metallic" in frame.maps and iteration > weights.half_metal_start:
        since = iteration - weights.half_metal_start
        weight = _risen(weights.half_metal, since, weights.half_metal_rise)
        loss += weight * losses.half_metal(frame.maps["metallic"], frame.object_alpha)
    if weights.materials and {*MATERIALS} <= {*frame.maps}:
        maps = [dr.detach(frame.object_alpha) * frame.maps[name] for name in MATERIALS]
        loss += weights.materials * losses.smoothness(maps, target.image, width, height, MATERIAL_EDGE)
    if weights.light_colour and light is not None:
        loss += weights.light_colour * losses.light_colour(light)
    if weights.alpha and target.alpha is not None:
        loss += weights.alpha * losses.alpha_loss(frame.alpha, target.alpha)
    squares = (dr.square(dr.detach(a) - b) for a, b in zip(image, target.image, strict=True))
    return loss, dr.mean(sum(squares, mi.Float(0))) / 3


def _risen(weight: float, since: int, rise: int) -> Any:
    """A weight that rises linearly from 0 in `rise` iterations.

    Opaque: it changes from step to step, and a literal would be compiled into each one's kernels.
    """
    return dr.opaque(mi.Float, weight * (min(since / rise, 1) if rise else 1))
