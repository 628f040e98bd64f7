"""Oracle of the splatter: one thing after another over whole images, float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.pinhole import PinholeCamera
from mi_refgs.reference.primitives import primitive_of


@dataclass(frozen=True)
class Maps:
    """Blended maps of shape (H, W, …) and the pixels where a declared discontinuity is near."""

    features: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    band: np.ndarray


def splat(
    raw: dict[str, np.ndarray], features: np.ndarray, camera: PinholeCamera, band: float = 1e-3
) -> Maps:
    """Render raw channels with features (N, K); `band` is the relative width of the declared band."""
    height, width = camera.height, camera.width
    found, order = primitive_of(raw).images(raw, camera, band)
    alphas, depths, jumps = (np.stack(values) for values in zip(*found, strict=True))
    row, column = np.mgrid[0:height, 0:width]
    out = np.zeros((height, width, features.shape[1]))
    depth, alpha = np.zeros((height, width)), np.zeros((height, width))
    transmittance = np.ones((height, width))
    alive = np.ones((height, width), bool)
    in_band = np.zeros((height, width), bool)

    for i in order:  # (H, W): the next one of each pixel
        a, z, jump = (values[i, row, column] for values in (alphas, depths, jumps))
        after = transmittance * (1 - a)
        shown = alive & (a >= c.ALPHA_MIN) & (z > camera.near)
        in_band |= alive & (np.abs(a / c.ALPHA_MIN - 1) < band)
        in_band |= shown & (np.abs(after / c.TRANSMITTANCE_MIN - 1) < band)
        in_band |= shown & jump
        in_band |= alive & (np.abs(z / camera.near - 1) < band)
        in_band |= shown & (np.abs(a - c.ALPHA_MAX) < band * (a < c.ALPHA_MAX))
        ends = shown & (after < c.TRANSMITTANCE_MIN)
        alive &= ~ends
        shown &= ~ends
        w = np.where(shown, transmittance * a, 0)
        out += w[..., None] * features[i]
        depth += w * np.where(shown, z, 0)
        alpha += w
        transmittance = np.where(shown, after, transmittance)
    return Maps(out, depth, alpha, in_band)
