"""Oracle of the splatter: surfel after surfel over whole images, float64, textbook ray-plane intersection."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mi_refgs import constants as c


@dataclass(frozen=True)
class PinholeCamera:
    """The numbers of `splat.camera.Camera` in float64."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    to_world: np.ndarray  # (4, 4)
    near: float = 0.01


@dataclass(frozen=True)
class Maps:
    """Blended maps of shape (H, W, …) and the pixels where a declared discontinuity is near."""

    features: np.ndarray
    depth: np.ndarray
    alpha: np.ndarray
    median_depth: np.ndarray
    band: np.ndarray


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion (x, y, z, w) of any norm."""
    x, y, z, w = q / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def splat(
    raw: dict[str, np.ndarray], features: np.ndarray, camera: PinholeCamera, band: float = 1e-3
) -> Maps:
    """Render raw channels with features (N, K); `band` is the relative width of the declared band."""
    height, width = camera.height, camera.width
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    centres = (raw["position"] - origin) @ to_camera.T

    out = np.zeros((height, width, features.shape[1]))
    depth, alpha, median = np.zeros((height, width)), np.zeros((height, width)), np.zeros((height, width))
    transmittance = np.ones((height, width))
    alive = np.ones((height, width), bool)
    in_band = np.zeros((height, width), bool)

    for i in np.argsort(centres[:, 2], kind="stable"):
        p = centres[i]
        axes = to_camera @ rotation_matrix(raw["rotation"][i])
        t_u, t_v, n = axes.T
        s_u, s_v = np.exp(raw["scale"][i])
        opacity = 1 / (1 + np.exp(-raw["opacity"][i, 0]))
        if p[2] <= camera.near or abs(p @ n) <= c.EDGE_ON_COSINE * np.linalg.norm(p) or opacity < c.ALPHA_MIN:
            continue
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (p @ n) / (ray @ n)
            offset = t[..., None] * ray - p
            rho_plane = (offset @ t_u / s_u) ** 2 + (offset @ t_v / s_v) ** 2
        rho_plane = np.where(t > 0, rho_plane, np.inf)
        px, py = camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy
        rho_screen = c.LOW_PASS_INV_VARIANCE * ((x - px) ** 2 + (y - py) ** 2)
        z = np.where(rho_screen < rho_plane, p[2], t)
        a = np.minimum(c.ALPHA_MAX, opacity * np.exp(-0.5 * np.minimum(rho_plane, rho_screen)))

        after = transmittance * (1 - a)
        shown = alive & (a >= c.ALPHA_MIN) & (z > camera.near)
        in_band |= alive & (np.abs(a / c.ALPHA_MIN - 1) < band)
        in_band |= shown & (np.abs(after / c.TRANSMITTANCE_MIN - 1) < band)
        in_band |= shown & (np.abs(rho_screen - rho_plane) < band * rho_screen)  # depth jumps there
        in_band |= alive & (np.abs(z / camera.near - 1) < band)
        in_band |= shown & (np.abs(a - c.ALPHA_MAX) < band * (a < c.ALPHA_MAX))
        in_band |= shown & (np.abs(transmittance - c.MEDIAN_TRANSMITTANCE) < band)
        ends = shown & (after < c.TRANSMITTANCE_MIN)
        alive &= ~ends
        shown &= ~ends
        w = np.where(shown, transmittance * a, 0)
        out += w[..., None] * features[i]
        depth += w * np.where(shown, z, 0)
        alpha += w
        median = np.where(shown & (transmittance > c.MEDIAN_TRANSMITTANCE), z, median)
        transmittance = np.where(shown, after, transmittance)
    return Maps(out, depth, alpha, median, in_band)
