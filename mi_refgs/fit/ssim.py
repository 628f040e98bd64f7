"""Structural similarity on Dr.Jit planes, with a hand-derived adjoint made of gathers only.

Letters: x, y the two images, μ = G x, q = G (x² + y²), p = G (x y) with G the Gaussian window;
    S = (2 μx μy + C1) (2 (p - μx μy) + C2) / ((μx² + μy² + C1) (q - μx² - μy² + C2))   [Wang 2004, (13)]
G is symmetric and reads zeros outside the image, hence Gᵀ = G and the adjoint is three more blurs:
    δx = G(∂S/∂μx) + 2x G(∂S/∂q) + y G(∂S/∂p).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi

# Half width of the 11-pixel window, in pixels. [Wang et al. 2004, §III.B]
WINDOW_RADIUS = 5
# Standard deviation of the window, in pixels. [ibid.]
WINDOW_SIGMA = 1.5
# (0.01 L)² and (0.03 L)² for the dynamic range L = 1. [ibid.]
C1 = 1e-4
C2 = 9e-4


def window() -> list[float]:
    """The 11 weights of the one-dimensional window; they sum to 1."""
    weights = [math.exp(-0.5 * (k / WINDOW_SIGMA) ** 2) for k in range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


def ssim(x: Sequence[Any], y: Sequence[Any], width: int, height: int) -> Any:
    """Mean SSIM (mi.Float, width 1) of two images given as planes (mi.Float, raster order) in [0, 1].

    Window 11×11, σ = 1.5, zero padding, mean over pixels and planes: the definition that 3DGS trains with.
    The reference image y has no derivative.
    """
    return dr.custom(_Ssim, list(x), [dr.detach(plane) for plane in y], width, height)


def _blur_axis(sources: Sequence[Any], width: int, height: int, axis: int, derive: Any = None) -> list[Any]:
    """Blur planes along x (axis 0) or y (axis 1); `derive` makes the values to blur under a tap."""
    pixel = dr.arange(mi.UInt32, width * height)
    place, size, stride = (pixel % width, width, 1) if axis == 0 else (pixel // width, height, width)
    total: list[Any] = []
    for k, weight in zip(range(-WINDOW_RADIUS, WINDOW_RADIUS + 1), window(), strict=True):
        # A place left of the image wraps to a huge unsigned number, so one comparison guards both ends.
        inside = place + mi.UInt32(k % 2**32) < size
        index = pixel + mi.UInt32((k * stride) % 2**32)
        values = [dr.gather(mi.Float, source, index, inside) for source in sources]
        values = derive(values) if derive else values
        if total:
            total = [dr.fma(value, weight, partial) for value, partial in zip(values, total, strict=True)]
        else:
            total = [value * weight for value in values]
    return total


def _moments(values: list[Any]) -> list[Any]:
    """(x₁…, y₁…) → (x₁…, y₁…, x₁² + y₁²…, x₁ y₁…)."""
    x, y = values[: len(values) // 2], values[len(values) // 2 :]
    squares = [a * a + b * b for a, b in zip(x, y, strict=True)]
    return [*x, *y, *squares, *(a * b for a, b in zip(x, y, strict=True))]


class _Ssim(dr.CustomOp):
    def eval(self, x: list[Any], y: list[Any], width: int, height: int) -> Any:
        self.x, self.y, self.size = x, y, (width, height)
        planes = len(x)
        dr.eval(x, y)
        rows = _blur_axis([*x, *y], width, height, 0, _moments)
        dr.eval(rows)
        blurred = _blur_axis(rows, width, height, 1)
        μx, μy, q, p = (blurred[i * planes : (i + 1) * planes] for i in range(4))
        value, self.slopes = mi.Float(0), []
        slopes: list[list[Any]] = [[], [], []]
        for i in range(planes):
            a1, a2 = 2 * μx[i] * μy[i] + C1, 2 * (p[i] - μx[i] * μy[i]) + C2
            b1 = μx[i] * μx[i] + μy[i] * μy[i] + C1
            b2 = q[i] - μx[i] * μx[i] - μy[i] * μy[i] + C2
            similarity = a1 * a2 / (b1 * b2)
            value += similarity
            slopes[0].append(
                2 * μy[i] * (a2 - a1) / (b1 * b2) - 2 * μx[i] * similarity * (1 / b1 - 1 / b2)
            )  # ∂S/∂μx
            slopes[1].append(-similarity / b2)  # ∂S/∂q
            slopes[2].append(2 * a1 / (b1 * b2))  # ∂S/∂p
        self.slopes = [*slopes[0], *slopes[1], *slopes[2]]
        dr.eval(value, self.slopes)
        return dr.sum(value) / (planes * width * height)

    def gradient(self) -> list[Any]:
        """∂(mean S)/∂x per plane."""
        width, height = self.size
        planes = len(self.x)
        columns = _blur_axis(self.slopes, width, height, 1)
        dr.eval(columns)
        blurred = _blur_axis(columns, width, height, 0)
        by_mean, by_square, by_product = (blurred[i * planes : (i + 1) * planes] for i in range(3))
        return [
            (by_mean[i] + 2 * self.x[i] * by_square[i] + self.y[i] * by_product[i])
            / (planes * width * height)
            for i in range(planes)
        ]

    def forward(self) -> None:
        products = [slope * δ for slope, δ in zip(self.gradient(), self.grad_in("x"), strict=True)]
        self.set_grad_out(dr.sum(sum(products[1:], products[0])))

    def backward(self) -> None:
        δ = self.grad_out()
        self.set_grad_in("x", [slope * δ for slope in self.gradient()])

    def name(self) -> str:
        return "ssim"
