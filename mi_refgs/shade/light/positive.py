"""Positive radiance of any raw value, and back: the activation of lights."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from mi_refgs.constants import RAW_LIMIT
from mi_refgs.kernels.device import upload

ATANH_TERMS = 7
"""Terms of the series of log(1 + e) in softplus: relative error below 1e-7 for e ≤ 1."""


def softplus(x: Any) -> Any:
    """log(1 + exp x) to full relative precision for every finite x, with a finite derivative."""
    e = dr.exp(-dr.abs(x))
    # log(1 + e) = 2 atanh(e / (2 + e)): 1 + e alone would round away all of a dark texel.
    s = e / (2 + e)
    series = dr.zeros(type(x), dr.width(x))
    for n in reversed(range(ATANH_TERMS)):
        series = dr.fma(series, s * s, 1 / (2 * n + 1))
    return 0.5 * x + 0.5 * dr.abs(x) + 2 * s * series  # not max(0, x), whose slope at 0 is not ½


def bounded(value: Any, raw: Any) -> Any:
    """The value, or 0 with gradient 0 where |raw| is not < RAW_LIMIT: a NaN would spread over all levels."""
    return dr.select(dr.abs(dr.detach(raw)) < RAW_LIMIT, value, 0)


def inverse_softplus(radiance: np.ndarray) -> np.ndarray:
    """Raw value of a positive radiance, float64."""
    y = np.asarray(radiance, np.float64)
    return y + np.log(-np.expm1(-y))


def nearest_raw(radiance: np.ndarray) -> np.ndarray:
    """Raw float32 values whose softplus, as the device rounds it, is nearest to the radiance.

    A light that was read, written and read again is the same, bit for bit; by `inverse_softplus` alone 2 %
    of the texels are not, and pictures differ by 1e-6.
    """
    wanted, exact = radiance.astype(np.float32), inverse_softplus(radiance)
    step = np.maximum(np.spacing(np.abs(exact).astype(np.float32)), np.spacing(wanted) / -np.expm1(-radiance))
    tried = np.stack([exact + k * step for k in (0, -1, 1, -2, 2)]).astype(np.float32)
    shown = softplus(upload(tried)).numpy().reshape(tried.shape)
    nearest = np.argmin(np.abs(shown.astype(np.float64) - wanted), axis=0)
    return np.take_along_axis(tried, nearest[None], axis=0)[0]
