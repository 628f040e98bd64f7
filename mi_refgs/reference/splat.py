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

    surfels = _surfels(raw, centres, to_camera, camera)
    order = _order(surfels, camera)
    out = np.zeros((height, width, features.shape[1]))
    depth, alpha = np.zeros((height, width)), np.zeros((height, width))
    transmittance = np.ones((height, width))
    alive = np.ones((height, width), bool)
    in_band = np.zeros((height, width), bool)

    for i in order:  # (H, W): the next surfel of each pixel
        s = {name: values[i] for name, values in surfels.items()}
        p = s["p"]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum(p * s["n"], -1) / np.sum(ray * s["n"], -1)
            offset = t[..., None] * ray - p
            rho_plane = np.sum(offset * s["u"], -1) ** 2 + np.sum(offset * s["v"], -1) ** 2
        rho_plane = np.where(t > 0, rho_plane, np.inf)
        rho_screen = c.LOW_PASS_INV_VARIANCE * (
            (x - s["centre"][..., 0]) ** 2 + (y - s["centre"][..., 1]) ** 2
        )
        z = np.where(rho_screen < rho_plane, p[..., 2], t)
        a = np.minimum(c.ALPHA_MAX, s["opacity"] * np.exp(-0.5 * np.minimum(rho_plane, rho_screen)))

        after = transmittance * (1 - a)
        shown = alive & (a >= c.ALPHA_MIN) & (z > camera.near)
        in_band |= alive & (np.abs(a / c.ALPHA_MIN - 1) < band)
        in_band |= shown & (np.abs(after / c.TRANSMITTANCE_MIN - 1) < band)
        in_band |= shown & (np.abs(rho_screen - rho_plane) < band * rho_screen)  # depth jumps there
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


def _surfels(
    raw: dict[str, np.ndarray], centres: np.ndarray, to_camera: np.ndarray, camera: PinholeCamera
) -> dict[str, np.ndarray]:
    """Per surfel: centre p, tangents u and v over their σ, normal n (camera frame), projection, opacity.

    Culled surfels stay, with opacity 0.
    """
    axes = np.array([to_camera @ rotation_matrix(q) for q in raw["rotation"]]).reshape(-1, 3, 3)
    sigma = np.exp(raw["scale"])
    opacity = 1 / (1 + np.exp(-raw["opacity"][:, 0]))
    facing = np.abs(np.sum(centres * axes[:, :, 2], axis=1))
    culled = centres[:, 2] <= camera.near
    culled |= facing <= c.EDGE_ON_COSINE * np.linalg.norm(centres, axis=1)
    culled |= opacity < c.ALPHA_MIN
    focal, middle = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    return {
        "p": centres,
        "u": axes[:, :, 0] / sigma[:, :1],
        "v": axes[:, :, 1] / sigma[:, 1:],
        "n": axes[:, :, 2],
        "centre": focal * centres[:, :2] / np.where(culled, 1, centres[:, 2])[:, None] + middle,
        "opacity": np.where(culled, 0, opacity),
    }


def _order(surfels: dict[str, np.ndarray], camera: PinholeCamera) -> np.ndarray:
    """Surfel indices (N, H, W), front to back by the depth near the centre of each pixel's tile.

    With the ray (x, y, 1) through that centre, 1/z of a surfel's plane is (ray·n) / (p·n). The point on the
    plane is brought to within SORT_REACH σ of p along 1/z, which is linear across the screen.
    """
    p, n = surfels["p"], surfels["n"]
    shown = surfels["opacity"] > 0
    k = 1 / np.where(shown, p[:, 2], 1)
    pn = np.where(shown, np.sum(p * n, axis=1), 1)
    order = np.zeros((len(p), camera.height, camera.width), int)
    width, height = c.tile_size(abs(camera.fx))
    for top in range(0, camera.height, height):
        for left in range(0, camera.width, width):
            x, y = left + width / 2, top + height / 2
            ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1])
            beside = ray - k[:, None] * p  # in the plane z = 1, from the projected centre
            across = beside - (np.sum(beside * n, axis=1) / pn)[:, None] * p
            distance = np.hypot(np.sum(across * surfels["u"], axis=1), np.sum(across * surfels["v"], axis=1))
            share = np.minimum(1, c.SORT_REACH * k / np.maximum(distance, 1e-10))
            inverse = np.maximum(k + share * (n @ ray / pn - k), k / c.SORT_DEPTH_RANGE)
            ranked = np.argsort(1 / inverse, kind="stable")
            order[:, top : top + height, left : left + width] = ranked[:, None, None]
    return order
