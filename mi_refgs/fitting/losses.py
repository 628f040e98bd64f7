"""Losses on images given as planes: lists of mi.Float (H*W,) in raster order, or a mi.Color3f.

Letters: I rendered image, T target, A accumulated alpha, L linear radiance, N blended normal Σ w n (not
unit). Every loss is of width 1, is zero for a perfect image, and has finite gradients for finite input.
Targets, weights and masks have no derivative."""

from collections.abc import Iterable

import drjit as dr
import mitsuba as mi

from mi_refgs.constants import GOLDEN_ANGLE
from mi_refgs.fitting.ssim import ssim
from mi_refgs.io.images import SATURATED
from mi_refgs.kernels.rows import columns_of
from mi_refgs.render.stencil import STEPS, neighbours
from mi_refgs.shade.light.light import Light
from mi_refgs.types import Bool, Color3f, Float, TensorXf, Vector3f

CLIPPED = 0.9  # linear radiance from which a photograph may be clipped: the light may be brighter, not darker
HUE = 0.3  # weight of the colour of light that no photograph shows


def saturated(
    target: Iterable[Float], alpha: Float | None = None, background: Iterable[float] = (0, 0, 0)
) -> list[Bool]:
    """Masks (mi.Bool planes) of where the object's own colour is clipped in a display-encoded target:
    (target - (1 - A) background) / A ≥ 254.5/255, and A > 0; without `alpha`, every pixel is the object's."""
    if alpha is None:
        return [plane >= SATURATED for plane in target]
    return [
        (alpha > 0) & (plane - (1 - alpha) * behind >= SATURATED * alpha)
        for plane, behind in zip(target, background, strict=True)
    ]


def clip_highlights(render: Iterable[Float], target: Iterable[Float], clipped: Iterable[Bool]) -> list[Float]:
    """Replace rendered values above a clipped target value by the latter, without gradient."""
    return [
        dr.select(mask & (plane > goal), dr.detach(goal), plane)
        for plane, goal, mask in zip(render, target, clipped, strict=True)
    ]


def planes(image: TensorXf) -> list[Float]:
    """The channels (H·W,) of an image (H, W, C), as `mi.render` returns it, under AD."""
    return columns_of(image.array, int(image.shape[-1]))


def l1(render: Iterable[Float], target: Iterable[Float]) -> Float:
    """Mean absolute difference over pixels and planes; the slope at equality is 0."""
    render, target = list(render), [dr.detach(plane) for plane in target]
    return _mean(sum((_abs(a - b) for a, b in zip(render, target, strict=True)), mi.Float(0))) / len(render)


def d_ssim(render: Iterable[Float], target: Iterable[Float], width: int, height: int) -> Float:
    """1 - SSIM (not halved), as 3DGS weighs it against `l1`."""
    return 1 - ssim(list(render), list(target), width, height)


def alpha_loss(alpha: Float, target: Float) -> Float:
    """Mean absolute difference of accumulated alpha and a mask in [0, 1]."""
    return _mean(_abs(alpha - dr.detach(target)))


def normal_consistency(
    normal: Vector3f, depth_normal: Vector3f, valid: Bool, alpha: Float, covered: Float | None = None
) -> Float:
    """Mean over all pixels of A (a - N · n_d), with A detached and only where n_d is valid.

    This is Σ wᵢ (1 - nᵢ · n_d) of 2DGS (eq. 13), weighted by A. normal: N, premultiplied; depth_normal: n_d,
    unit; gradients flow to both. `covered` is a, the opacity of surfels that have normals, with gradients; by
    default it is A detached, as in the code of 2DGS."""
    weight = dr.select(valid, dr.detach(alpha), 0.0)
    covered = weight if covered is None else covered
    return _mean(weight * (covered - dr.dot(mi.Vector3f(normal), mi.Vector3f(depth_normal))))


def smoothness(
    planes: Iterable[Float], image: Iterable[Float], width: int, height: int, edge: float = 1.0
) -> Float:
    """Edge-aware smoothness ‖∇M‖ exp(-edge ‖∇I‖) of the maps M (`planes`): pixel mean, sum over axes.

    With the normals' planes and edge = 1 this is the smoothness of Ref-Gaussian (§3.3). ∇ is Sobel / 8 with
    the border repeated; ‖·‖ is the mean absolute value over the planes. Gradients flow to M only."""
    total = mi.Float(0)
    map_slopes = [sobel(plane, width, height) for plane in planes]
    image_slopes = [sobel(dr.detach(plane), width, height) for plane in image]
    for axis in (0, 1):
        bend = sum((_abs(slopes[axis]) for slopes in map_slopes), mi.Float(0)) / len(map_slopes)
        step = sum((dr.abs(slopes[axis]) for slopes in image_slopes), mi.Float(0)) / len(image_slopes)
        total += bend * dr.exp(-edge * step)
    return _mean(total)


def sobel(plane: Float, width: int, height: int) -> tuple[Float, Float]:
    """Sobel derivatives (∂x, ∂y) of a plane, divided by 8 (per pixel), the border repeated."""
    at = dict(zip(STEPS, neighbours(plane, width, height, STEPS), strict=True))
    along_x = at[1, -1] - at[-1, -1] + 2 * (at[1, 0] - at[-1, 0]) + at[1, 1] - at[-1, 1]
    along_y = at[-1, 1] - at[-1, -1] + 2 * (at[0, 1] - at[0, -1]) + at[1, 1] - at[1, -1]
    return along_x / 8, along_y / 8


def undecided(value: Float, alpha: Float) -> Float:
    """Mean over all pixels of A x (1 - x), with A detached, of values x: 0 if all are 0 or 1."""
    return _mean(dr.detach(alpha) * value * (1 - value))


def light_colour(light: Light) -> Float:
    """Colour of the irradiance: mean of |E - grey E| over the mean of E, in 256 directions all around."""
    index = dr.arange(mi.Float, 256)
    height = 1 - (index + 0.5) * (2 / 256)
    sin, cos = dr.sincos(index * GOLDEN_ANGLE)
    ring = dr.sqrt(1 - dr.square(height))
    irradiance = light.irradiance(mi.Vector3f(ring * cos, ring * sin, height))
    grey = (irradiance.x + irradiance.y + irradiance.z) / 3
    off = sum((_abs(part - grey) for part in irradiance), mi.Float(0)) / 3
    return dr.sum(off) / dr.detach(dr.sum(grey))


def light_difference(radiance: Color3f, photographed: Color3f, seen: Float, area: Float) -> Float:
    """Mean |d| over channels and N directions, d = log((1 + L) / (1 + P)), for radiance L and P (width 1).

    Where P is above CLIPPED, a brighter L costs nothing. A direction counts by its `area` (they sum to 1)
    times `seen`, 0 … 1; the rest counts HUE times by its deviation from the mean d of the channels: what no
    photograph shows is as bright as reflections say, in the colour of P."""
    off = [dr.log(1 + own) - dr.log(1 + other) for own, other in zip(radiance, photographed, strict=True)]
    grey = (off[0] + off[1] + off[2]) / 3
    total = mi.Float(0)
    for d, other in zip(off, photographed, strict=True):
        total += seen * dr.select((other > CLIPPED) & (d > 0), 0, _abs(d)) + HUE * (1 - seen) * _abs(d - grey)
    return dr.sum(area * total) / 3


def _abs(difference: Float) -> Float:
    """|x| with slope 0 at 0: equal values must not push."""
    return dr.select(difference == 0, 0.0, dr.abs(difference))


def _mean(plane: Float) -> Float:
    return dr.sum(plane) / dr.width(plane)
