"""Several samples per pixel: a view is rendered larger, and its pixels are averaged."""

import math
from collections.abc import Callable
from dataclasses import replace

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import COVERAGE_FLOOR
from mi_refgs.errors import require_between
from mi_refgs.kernels.linear import linear
from mi_refgs.kernels.trees import mapped
from mi_refgs.render.pipeline import Frame
from mi_refgs.splat.camera import Camera
from mi_refgs.splat.composite import inverse_alpha
from mi_refgs.types import Arrays, Color3f, Float


def samples_per_axis(samples: int) -> int:
    """k of the k × k regular samples for a sample count: ⌈√samples⌉; raises InputError for less than 1."""
    require_between(samples, "samples", 1)
    return math.ceil(math.sqrt(samples))


def supersampled(view: Callable[[Camera], Frame], camera: Camera, samples: int, maps: bool = True) -> Frame:
    """Render a frame with k × k box-filtered samples per pixel (`samples_per_axis`), under AD; without
    `maps` neither these nor terms. Compositing it equals the mean of composited samples."""
    factor = samples_per_axis(samples)
    fine_camera = camera.supersampled(factor)
    fine = view(fine_camera)
    if factor == 1:
        return fine
    if not maps:
        fine = replace(fine, terms=None, maps={})

    def mean(value: Arrays) -> Arrays:
        return mapped(lambda plane: box_mean(plane, camera, factor), value)

    alpha = mean(fine.alpha)
    object_alpha = alpha if fine.object_alpha is fine.alpha else mean(fine.object_alpha)
    inverse = inverse_alpha(alpha)

    def by_alpha(value: Float) -> Float:
        return mean(value * fine.alpha) * inverse

    def behind(background: Color3f) -> Color3f:
        through = 1 - alpha
        weighted = mean(background * (1 - fine.alpha)) * inverse_alpha(through)
        return dr.select(through <= COVERAGE_FLOOR, mean(background), weighted)

    distance = None
    if maps and fine.depth is not None:
        distance = by_alpha(ray_distance(fine.depth, fine_camera))
    return replace(
        fine,
        alpha=alpha,
        depth=None if fine.depth is None else by_alpha(fine.depth),
        normal=mean(fine.normal),
        radiance=mean(fine.radiance),
        terms=mean(fine.terms),
        maps={
            name: mean(value * fine.object_alpha) * inverse_alpha(object_alpha)
            for name, value in fine.maps.items()
        },
        background=None if fine.background is None else behind(fine.background),
        object_alpha=object_alpha,
        distance=distance,
    )


def ray_distance(depth: Float, camera: Camera) -> Float:
    """Distance along the rays from the near plane to a camera-z depth per pixel."""
    return (depth - camera.near) * dr.norm(camera.rays())


def box_mean(plane: Float, camera: Camera, factor: int) -> Float:
    """Mean of each factor × factor block of a supersampled plane; one of width 1 is constant."""
    if factor == 1 or dr.width(plane) == 1:
        return plane
    width, samples = camera.width, factor * factor
    count = width * camera.height * samples

    def mean(plane: Float) -> Float:
        sample = dr.arange(mi.UInt32, count)
        pixel, part = sample // samples, sample % samples
        x = (pixel % width) * factor + part % factor
        y = (pixel // width) * factor + part // factor
        return dr.block_sum(dr.gather(mi.Float, plane, y * (width * factor) + x), samples) / samples

    def spread(mean: Float) -> Float:
        sample = dr.arange(mi.UInt32, count)
        x, y = sample % (width * factor), sample // (width * factor)
        return dr.gather(mi.Float, mean, (y // factor) * width + x // factor) / samples

    return linear(plane, mean, spread)
