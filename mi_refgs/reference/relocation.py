"""What several Gaussians at one place must be to look like one, in float64 [3DGS-MCMC, eq. 9]."""

from __future__ import annotations

import math


def shared(opacity: float, number: int) -> tuple[float, float]:
    """Opacity of each of `number` Gaussians, and the factor of their scales: eq. 9 as printed."""
    new = 1 - (1 - opacity) ** (1 / number)
    total = 0.0
    for i in range(1, number + 1):
        for k in range(i):
            total += math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
    return new, opacity / total


def line_integral(opacity: float, number: int, scale: float, steps: int = 20_000) -> float:
    """∫ 1 - (1 - o exp(-x²/2s²))^N dx along a line through their centre, by the middles of equal steps."""
    width, total = 20 * scale, 0.0
    for i in range(steps):
        x = ((i + 0.5) / steps - 0.5) * width
        total += 1 - (1 - opacity * math.exp(-0.5 * (x / scale) ** 2)) ** number
    return total * width / steps
