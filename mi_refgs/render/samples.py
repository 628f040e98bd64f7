"""Several samples a pixel: a view is rendered larger, and its pixels are averaged."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.errors import InputError
from mi_refgs.render.gbuffer import inverse_alpha
from mi_refgs.render.pipeline import Frame
from mi_refgs.shade.points import RadianceTerms
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

    Linear radiance, its terms, normals and alpha are premultiplied: they are averaged as they are. Depth is
    weighted by alpha, maps by the opacity of the object, and the background by 1 - alpha, so that compositing
    the mean frame equals the mean of composited samples. The sRGB encoding comes after, as for a path-traced
    image with a box filter. Without `details`, there are neither terms nor maps: each mean is a kernel of its
    own, used or not.
    """
    factor = samples_per_axis(samples)
    fine_camera = camera.supersampled(factor)
    fine = view(fine_camera)
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

    alphas: dict[int, Any] = {}  # two or all of the three may be one array
    for value in (fine.alpha, fine.object_alpha, fine.normal_alpha):
        if id(value) not in alphas:
            alphas[id(value)] = maybe(value)
    alpha, object_alpha = alphas[id(fine.alpha)], alphas[id(fine.object_alpha)]
    inverse = inverse_alpha(alpha)

    def by_alpha(value: Any) -> Any:
        return mean(value * fine.alpha) * inverse

    distance = None
    if details and fine.depth is not None:
        distance = by_alpha(ray_distance(fine.depth, fine_camera))
    terms = None
    if fine.terms is not None:
        terms = RadianceTerms(**{name: mean(term) for name, term in fine.terms.known().items()})
    return replace(
        fine,
        alpha=alpha,
        depth=None if fine.depth is None else by_alpha(fine.depth),
        normal=maybe(fine.normal),
        radiance=mean(fine.radiance),
        terms=terms,
        maps={
            name: mean(value * fine.object_alpha) * inverse_alpha(object_alpha)
            for name, value in fine.maps.items()
        },
        background=None if fine.background is None else mean_behind(mean, fine.background, fine.alpha),
        object_alpha=object_alpha,
        normal_alpha=alphas[id(fine.normal_alpha)],
        distance=distance,
    )


def mean_behind(mean: Callable[[Any], Any], background: Any, alpha: Any) -> Any:
    """Mean background (mi.Color3f) weighted by 1 - alpha; the plain mean where alpha is 1."""
    through = 1 - mean(alpha)
    hidden = through <= COVERAGE_FLOOR
    weighted = mean(background * (1 - alpha)) * inverse_alpha(through)
    return dr.select(hidden, mean(background), weighted)


def ray_distance(depth: Any, camera: Camera) -> Any:
    """Distance along the rays of a camera from its near plane to camera-z depths of its pixels."""
    return (depth - camera.near) * dr.norm(camera.rays())


def box_mean(channel: Any, camera: Camera, factor: int) -> Any:
    """Mean of each factor × factor block of a supersampled raster; a channel of width 1 is constant."""
    if factor == 1 or dr.width(channel) == 1:
        return channel
    return dr.custom(_BoxMean, channel, camera.width, camera.height, factor)


class _BoxMean(dr.CustomOp):
    """Mean of blocks of pixels; its adjoint gathers, and so adds to what else is read of the channel."""

    def eval(self, channel: Any, width: int, height: int, factor: int) -> Any:
        self.size = width, height, factor
        return self._mean(channel)

    def _mean(self, channel: Any) -> Any:
        width, height, factor = self.size
        sample = dr.arange(mi.UInt32, width * height * factor * factor)
        pixel, part = sample // (factor * factor), sample % (factor * factor)
        x = (pixel % width) * factor + part % factor
        y = (pixel // width) * factor + part // factor
        ordered = dr.gather(mi.Float, channel, y * (width * factor) + x)
        return dr.block_sum(ordered, factor * factor) / (factor * factor)

    def forward(self) -> None:
        self.set_grad_out(self._mean(self.grad_in("channel")))

    def backward(self) -> None:
        width, height, factor = self.size
        sample = dr.arange(mi.UInt32, width * height * factor * factor)
        x, y = sample % (width * factor), sample // (width * factor)
        δ = dr.gather(mi.Float, self.grad_out(), (y // factor) * width + x // factor)
        self.set_grad_in("channel", δ / (factor * factor))

    def name(self) -> str:
        return "box mean"
