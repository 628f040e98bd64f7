"""Losses on images given as planes: lists of mi.Float of width H·W in raster order (or a mi.Color3f).

Letters: I rendered image, T target, A accumulated alpha, L linear radiance, N blended normal Σ w n (not
unit). Every loss is a mi.Float of width 1, zero for a perfect image, and has finite gradients for finite
input. Targets, weights and masks have no derivative. SSIM is in `fitting.ssim`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import GOLDEN_ANGLE
from mi_refgs.fitting.ssim import ssim
from mi_refgs.render.stencil import neighbours
from mi_refgs.shade.light.light import Light

# An 8-bit target value of 255 stands for everything from here up: the sensor clipped.
SATURATED = 254.5 / 255.0
DIRECTIONS = 256
"""Directions that tell the colour of an irradiance: 13° from one to the next."""


def saturated(
    target: Iterable[Any], alpha: Any | None = None, background: Iterable[float] = (0, 0, 0)
) -> list[Any]:
    """Masks (mi.Bool planes) where the object's own colour is clipped in a display-encoded target.

    That is (target - (1 - A) background) / A ≥ 254.5/255, and A > 0: a white background is no highlight. With
    `alpha` None, every pixel is the object's.
    """
    if alpha is None:
        return [plane >= SATURATED for plane in target]
    return [
        (alpha > 0) & (plane - (1 - alpha) * behind >= SATURATED * alpha)
        for plane, behind in zip(target, background, strict=True)
    ]


def clip_highlights(render: Iterable[Any], target: Iterable[Any], clipped: Iterable[Any]) -> list[Any]:
    """The render with every value above a clipped target value replaced by it: no gradient there."""
    return [
        dr.select(mask & (plane > goal), dr.detach(goal), plane)
        for plane, goal, mask in zip(render, target, clipped, strict=True)
    ]


# ---------------- image losses ----------------


def l1(render: Iterable[Any], target: Iterable[Any]) -> Any:
    """Mean absolute difference over pixels and planes; the slope at equality is 0."""
    render, target = list(render), [dr.detach(plane) for plane in target]
    return _mean(sum((_abs(a - b) for a, b in zip(render, target, strict=True)), mi.Float(0))) / len(render)


def d_ssim(render: Iterable[Any], target: Iterable[Any], width: int, height: int) -> Any:
    """1 - SSIM (not halved), as 3DGS weighs it against `l1`."""
    return 1 - ssim(list(render), list(target), width, height)


def alpha_loss(alpha: Any, target: Any) -> Any:
    """Mean absolute difference of accumulated alpha and a mask in [0, 1]."""
    return _mean(_abs(alpha - dr.detach(target)))


# ---------------- geometry losses ----------------


def normal_consistency(normal: Any, depth_normal: Any, valid: Any, alpha: Any) -> Any:
    """Mean over all pixels of A (A - N · n_d), with A detached and only where n_d is valid.

    This is Σ wᵢ (1 - nᵢ · n_d) of 2DGS (eq. 13), weighted by A: its gradient is that of 1 - N · (n_d
    stopgrad(A)), but empty pixels count zero. normal: N premultiplied; depth_normal: unit
    (render.depth_normals). Gradients flow to both.
    """
    weight = dr.select(valid, dr.detach(alpha), 0.0)
    return _mean(weight * (weight - dr.dot(mi.Vector3f(normal), mi.Vector3f(depth_normal))))


def smoothness(
    planes: Iterable[Any], image: Iterable[Any], width: int, height: int, edge: float = 1.0
) -> Any:
    """Edge-aware smoothness ‖∇M‖ exp(-edge ‖∇I‖) of the maps M (`planes`): pixel mean, sum over axes.

    With the normals' planes and edge = 1 this is the smoothness of Ref-Gaussian (§3.3). ∇ is Sobel / 8 with
    the border repeated; ‖·‖ is the mean absolute value over the planes. Gradients flow to M only.
    """
    total = mi.Float(0)
    map_slopes = [sobel(plane, width, height) for plane in planes]
    image_slopes = [sobel(dr.detach(plane), width, height) for plane in image]
    for axis in (0, 1):
        bend = sum((_abs(slopes[axis]) for slopes in map_slopes), mi.Float(0)) / len(map_slopes)
        step = sum((dr.abs(slopes[axis]) for slopes in image_slopes), mi.Float(0)) / len(image_slopes)
        total += bend * dr.exp(-edge * step)
    return _mean(total)


def sobel(plane: Any, width: int, height: int) -> tuple[Any, Any]:
    """Sobel derivatives (∂x, ∂y) of a plane, divided by 8 (per pixel), the border repeated."""
    steps = [(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]
    at = dict(zip(steps, neighbours(plane, width, height, steps), strict=True))
    along_x = at[1, -1] - at[-1, -1] + 2 * (at[1, 0] - at[-1, 0]) + at[1, 1] - at[-1, 1]
    along_y = at[-1, 1] - at[-1, -1] + 2 * (at[0, 1] - at[0, -1]) + at[1, 1] - at[1, -1]
    return along_x / 8, along_y / 8


# ---------------- priors ----------------


def half_metal(metallic: Any, alpha: Any) -> Any:
    """Mean over all pixels of A m (1 - m), with A detached: 0 where every surface is a metal or none.

    Surfaces are one or the other; what is between them fits pictures with a light of any colour.
    """
    return _mean(dr.detach(alpha) * metallic * (1 - metallic))


def light_colour(light: Light) -> Any:
    """How coloured the light is that a matt surface gets: mean of |E - grey E| over that of E.

    E is the irradiance in DIRECTIONS all around. Pictures fix albedo times light only: whatever factor one
    gains a channel, the other may lose, and no picture tells. This prior gives the colour to the albedo; what
    mirrors and highlights show of the light, lamp by lamp, is finer than E. Highlights of a dielectric fix
    the scale of the light; for other surfaces no picture tells it, and it stays near that of the start.
    """
    index = dr.arange(mi.Float, DIRECTIONS)
    height = 1 - (index + 0.5) * (2 / DIRECTIONS)
    sin, cos = dr.sincos(index * GOLDEN_ANGLE)
    ring = dr.sqrt(1 - dr.square(height))
    irradiance = light.irradiance(mi.Vector3f(ring * cos, ring * sin, height))
    grey = (irradiance.x + irradiance.y + irradiance.z) / 3
    off = sum((_abs(part - grey) for part in irradiance), mi.Float(0)) / 3
    return dr.sum(off) / dr.detach(dr.sum(grey))


def _abs(difference: Any) -> Any:
    """|x| with slope 0 at 0: equal values must not push."""
    return dr.select(difference == 0, 0.0, dr.abs(difference))


def _mean(plane: Any) -> Any:
    return dr.sum(plane) / dr.width(plane)
