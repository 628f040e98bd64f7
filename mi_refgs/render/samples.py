"""Several samples a pixel: a view is rendered larger, and its pixels are averaged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.errors import InputError
from mi_refgs.render.gbuffer import inverse_alpha
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.points import Terms
from mi_refgs.splat.camera import Camera


def samples_per_axis(samples: int) -> int:
    """k of the k × k regular samples that a number of samples stands for: ⌈√samples⌉.

    Raises InputError for less than 1.
    """
    if samples < 1:
        raise InputError(f"samples: {samples} is out of range; give a number from 1")
    return math.ceil(math.sqrt(samples))


def supersampled(
    view: Callable[[Camera], Frame], camera: Camera, samples: int, details: bool = True
) -> Frame:
    """The frame of `view` with k × k samples a pixel (`samples_per_axis`), box filtered; under AD.

    Linear radiance, its terms, normals and alpha are averaged as they are, premultiplied; depth and maps,
    which are divided by alpha, are weighted by it. The encoding comes after: that is how a path-traced
    picture with a box filter is made. Without `details`, there are neither terms nor maps: each mean is a
    kernel of its own, used or not.
    """
    factor = samples_per_axis(samples)
    fine = view(camera.supersampled(factor))
    if factor == 1:
        return fine
    if not details:
        fine = replace(fine, terms=None, maps={})

    def mean(value: Any) -> Any:
        if dr.depth_v(value) > 1:
            return type(value)(*(box_mean(part, camera, factor) for part in value))
        return box_mean(value, camera, factor)

    def maybe(value: Any) -> Any:
        return None if value is None else mean(value)

    alpha, share = mean(fine.alpha), maybe(fine.share)
    inverse = inverse_alpha(alpha)
    of_object = inverse if share is None else inverse_alpha(share)
    by = fine.alpha if share is None else fine.share

    terms = None
    if fine.terms is not None:
        terms = Terms(**{name: mean(term) for name, term in fine.terms.known().items()})
    return replace(
        fine,
        alpha=alpha,
        depth=None if fine.depth is None else mean(fine.depth * fine.alpha) * inverse,
        normal=maybe(fine.normal),
        radiance=mean(fine.radiance),
        terms=terms,
        maps={name: mean(value * by) * of_object for name, value in fine.maps.items()},
        background=maybe(fine.background),
        share=share,
    )


def box_mean(channel: Any, camera: Camera, factor: int) -> Any:
    """Mean of each factor × factor block of a supersampled raster; a channel of width 1 is constant."""
    if factor == 1 or dr.width(channel) == 1:
        return channel
    sample = dr.arange(mi.UInt32, camera.width * camera.height * factor * factor)
    pixel, part = sample // (factor * factor), sample % (factor * factor)
    x = (pixel % camera.width) * factor + part % factor
    y = (pixel // camera.width) * factor + part // factor
    ordered = dr.gather(mi.Float, channel, y * (camera.width * factor) + x, mode=dr.ReduceMode.Permute)
    return dr.block_sum(ordered, factor * factor) / (factor * factor)
