"""Structural similarity on Dr.Jit planes, with a hand-derived adjoint made of gathers only.

Letters: x, y the two images, μ = G x, q = G (x² + y²), p = G (x y) with G the Gaussian window;
    S = (2 μx μy + C1) (2 (p - μx μy) + C2) / ((μx² + μy² + C1) (q - μx² - μy² + C2))   [Wang 2004, (13)]
G is symmetric and reads zeros outside the image, hence Gᵀ = G and the adjoint is three more blurs:
    δx = G(∂S/∂μx) + 2x G(∂S/∂q) + y G(∂S/∂p)."""

import functools
import math
from collections.abc import Callable, Sequence

import drjit as dr
import mitsuba as mi

from mi_refgs.kernels.device import replayed
from mi_refgs.kernels.timing import phase
from mi_refgs.types import Float

WINDOW_RADIUS = 5  # half width of the 11-pixel window, in pixels [Wang et al. 2004, §III.B]
WINDOW_SIGMA = 1.5  # standard deviation of the window, in pixels [ibid.]
RUN = 4  # pixels in a row that one lane blurs: they share most of what they read
C1, C2 = 1e-4, 9e-4  # (0.01 L)² and (0.03 L)² for the dynamic range L = 1 [ibid.]
_replayed = functools.partial(replayed, limit=8)  # image sizes: to trace takes as long as to run


def window() -> list[float]:
    """The weights of the one-dimensional window; they sum to 1."""
    weights = [math.exp(-0.5 * (k / WINDOW_SIGMA) ** 2) for k in range(-WINDOW_RADIUS, WINDOW_RADIUS + 1)]
    return [weight / sum(weights) for weight in weights]


@phase("ssim forward")
def ssim(x: Sequence[Float], y: Sequence[Float], width: int, height: int) -> Float:
    """Mean SSIM (width 1) of two images given as planes in [0, 1], with zero padding, as 3DGS trains with;
    the reference image y has no derivative."""
    return dr.custom(_Ssim, list(x), [dr.detach(plane) for plane in y], width, height)


def _blur(
    sources: Sequence[Float],
    width: int,
    height: int,
    axis: int,
    derive: Callable[[list[Float]], list[Float]] = list,
    finish: Callable[[list[Float], Float, Float], list[Float]] = lambda totals, pixel, inside: totals,
) -> list[Float]:
    """Blur planes along x (axis 0) or y (axis 1), evaluated. `derive` makes the values to blur of what is
    read; `finish` the planes to return of the blurred values, their pixel, and whether it is one."""
    size, lines, stride = (width, height, 1) if axis == 0 else (height, width, width)
    runs = -(-size // RUN)
    lane = dr.arange(mi.UInt32, runs * lines)
    run, line = (lane % runs, lane // runs) if axis == 0 else (lane // lines, lane % lines)
    first = run * RUN
    pixel = line * width + first if axis == 0 else first * width + line
    weights = window()
    totals: list[list[Float]] = [[] for _ in range(RUN)]
    for k in range(-WINDOW_RADIUS, RUN + WINDOW_RADIUS):
        # A place left of the image wraps to a huge unsigned number, so one comparison guards both ends.
        inside = first + mi.UInt32(k % 2**32) < size
        index = pixel + mi.UInt32((k * stride) % 2**32)
        values = derive([dr.gather(mi.Float, source, index, inside) for source in sources])
        for r in range(max(0, k - WINDOW_RADIUS), min(RUN, k + WINDOW_RADIUS + 1)):
            weight = weights[k - r + WINDOW_RADIUS]
            before = totals[r] or [mi.Float(0)] * len(values)
            totals[r] = [dr.fma(value, weight, total) for value, total in zip(values, before, strict=True)]
    planes: list[Float] = []
    for r in range(RUN):
        here, inside = pixel + r * stride, first + r < size
        results = finish(totals[r], here, inside)
        planes = planes or [dr.empty(mi.Float, width * height) for _ in results]
        for plane, value in zip(planes, results, strict=True):
            dr.scatter(plane, value, here, inside, mode=dr.ReduceMode.NoConflicts)
    dr.eval(planes)
    return planes


def _moments(values: list[Float]) -> list[Float]:
    """(x₁…, y₁…) → (x₁…, y₁…, x₁² + y₁²…, x₁ y₁…)."""
    x, y = values[: len(values) // 2], values[len(values) // 2 :]
    squares = [a * a + b * b for a, b in zip(x, y, strict=True)]
    return [*x, *y, *squares, *(a * b for a, b in zip(x, y, strict=True))]


def _similarity(blurred: list[Float], pixel: Float, inside: Float) -> list[Float]:
    """S summed over planes, then ∂S/∂μx, ∂S/∂q and ∂S/∂p of each, from what `_moments` gives."""
    planes = len(blurred) // 4
    μx, μy, q, p = (blurred[i * planes : (i + 1) * planes] for i in range(4))
    value, by_mean, by_square, by_product = mi.Float(0), [], [], []
    for i in range(planes):
        a1, a2 = 2 * μx[i] * μy[i] + C1, 2 * (p[i] - μx[i] * μy[i]) + C2
        b1 = μx[i] * μx[i] + μy[i] * μy[i] + C1
        b2 = q[i] - μx[i] * μx[i] - μy[i] * μy[i] + C2
        similarity = a1 * a2 / (b1 * b2)
        value += similarity
        by_mean.append(2 * μy[i] * (a2 - a1) / (b1 * b2) - 2 * μx[i] * similarity * (1 / b1 - 1 / b2))
        by_square.append(-similarity / b2)
        by_product.append(2 * a1 / (b1 * b2))
    return [value, *by_mean, *by_square, *by_product]


@_replayed
def _forward(x: list[Float], y: list[Float], width: int, height: int) -> list[Float]:
    """What `_similarity` gives at every pixel."""
    return _blur(_blur([*x, *y], width, height, 0, derive=_moments), width, height, 1, finish=_similarity)


@_replayed
def _gradient(x: list[Float], y: list[Float], slopes: list[Float], width: int, height: int) -> list[Float]:
    """∂(mean S)/∂x per plane, from the slopes of `_similarity`."""
    planes = len(x)

    def combine(blurred: list[Float], pixel: Float, inside: Float) -> list[Float]:
        by_mean, by_square, by_product = (blurred[i * planes : (i + 1) * planes] for i in range(3))
        a, b = ([dr.gather(mi.Float, plane, pixel, inside) for plane in image] for image in (x, y))
        return [
            (by_mean[i] + 2 * a[i] * by_square[i] + b[i] * by_product[i]) / (planes * width * height)
            for i in range(planes)
        ]

    return _blur(_blur(slopes, width, height, 1), width, height, 0, finish=combine)


class _Ssim(dr.CustomOp):
    def eval(self, x: list[Float], y: list[Float], width: int, height: int) -> Float:
        dr.make_opaque(x, y)  # a literal would be another recording
        self.x, self.y, self.size = x, y, (width, height)
        value, *self.slopes = _forward(x, y, width, height)
        return dr.sum(value) / (len(x) * width * height)

    def gradient(self) -> list[Float]:
        return _gradient(self.x, self.y, self.slopes, *self.size)

    def forward(self) -> None:
        products = [slope * δ for slope, δ in zip(self.gradient(), self.grad_in("x"), strict=True)]
        self.set_grad_out(dr.sum(sum(products[1:], products[0])))

    def backward(self) -> None:
        δ = self.grad_out()
        self.set_grad_in("x", [slope * δ for slope in self.gradient()])

    def name(self) -> str:
        return "ssim"
