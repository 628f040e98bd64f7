"""Footprints of surfels in float64: ray-plane intersection with a low-pass. See `reference.footprint`."""

from __future__ import annotations

import numpy as np

from mi_refgs import constants as c
from mi_refgs.reference.camera import (
    PinholeCamera,
    camera_frame,
    intrinsics,
    ray_slopes,
    rotation_matrix,
    sigmoid,
)
from mi_refgs.reference.footprint import Rules, Sample, tile_centres

Array = np.ndarray


def culled(raw: dict[str, Array], camera: PinholeCamera, rules: Rules) -> Array:
    """See `reference.footprint`."""
    centre, axes = camera_frame(raw, camera)
    facing = np.abs(np.sum(centre * axes[:, 2], axis=1))
    out = ~(centre[:, 2] > camera.near) | ~(facing > rules.edge_on * np.linalg.norm(centre, axis=1))
    return out | (sigmoid(raw["opacity"][:, 0]) < rules.alpha_min)


def footprint(raw: dict[str, Array], camera: PinholeCamera, rules: Rules, x: Array, y: Array) -> Sample:
    """See `reference.footprint`."""
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    ray = ray_slopes(camera, x, y)
    with np.errstate(all="ignore"):
        t = np.sum(p * axes[:, 2], axis=1)[:, None] / (axes[:, 2] @ ray)
        # Only the difference to the ray through the surfel's own centre meets the axes: nothing cancels.
        beside = ray[None] - (p / p[:, 2:])[:, :, None]
        plane = np.zeros_like(t)
        lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / np.sum(p * axes[:, 2], 1)[:, None]
        for i in range(2):
            along = np.einsum("nk,nkp->np", axes[:, i], beside)
            pa = np.sum(p * axes[:, i], 1)[:, None]
            plane = plane + (t * (along - lift * pa) / σ[:, i : i + 1]) ** 2
        middle = [f * p[:, i : i + 1] / p[:, 2:] + m for i, (f, m) in enumerate(intrinsics(camera))]
        screen = (x - middle[0]) ** 2 + (y - middle[1]) ** 2
        screen = screen * rules.low_pass if rules.low_pass else np.full_like(screen, np.inf)
        low_pass = ~(t.real > 0) | ~(screen.real >= plane.real)
        opacity = sigmoid(raw["opacity"])
        unclamped = opacity * np.exp(-0.5 * np.where(low_pass, screen, plane))
    alpha = np.where(unclamped.real > rules.alpha_max, rules.alpha_max, unclamped)
    z = np.where(low_pass, p[:, 2:], t)
    with np.errstate(all="ignore"):
        jump = np.abs(screen.real - plane.real) / screen.real
    return Sample(alpha, z, unclamped.real, jump)


def normal(raw: dict[str, Array]) -> Array:
    """The third axis."""
    return np.full(len(raw["position"]), 2)


def sort_key(raw: dict[str, Array], camera: PinholeCamera, pixels: Array, corner: tuple[int, int]) -> Array:
    """See `reference.footprint`; the depth of the plane, SORT_REACH σ from the centre at most."""
    p, axes = camera_frame(raw, camera)
    σ = np.exp(raw["scale"])
    x, y = tile_centres(camera, pixels, corner)
    ray = ray_slopes(camera, x, y)
    with np.errstate(all="ignore"):
        k = 1 / p[:, 2:]
        beside = ray[None] - (p * k)[:, :, None]
        pn = np.sum(p * axes[:, 2], 1)[:, None]
        lift = np.einsum("nk,nkp->np", axes[:, 2], beside) / pn
        across = [
            (np.einsum("nk,nkp->np", axes[:, i], beside) - lift * np.sum(p * axes[:, i], 1)[:, None])
            / σ[:, i : i + 1]
            for i in range(2)
        ]
        share = np.minimum(1, c.SORT_REACH * k / np.hypot(*across))
        return 1 / np.maximum(k + share * lift, k / c.SORT_DEPTH_RANGE)


# ---------------- by loops ----------------


def images(
    raw: dict[str, Array], camera: PinholeCamera, band: float
) -> tuple[list[tuple[Array, Array, Array]], Array]:
    """See `reference.footprint`; textbook ray-plane intersection."""
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], axis=-1)
    surfels = camera_surfels(raw, camera)
    found = []
    for i in range(len(raw["position"])):
        s = {name: values[i] for name, values in surfels.items()}
        p = s["p"]
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.sum(p * s["n"], -1) / np.sum(ray * s["n"], -1)
            offset = t[..., None] * ray - p
            rho_plane = np.sum(offset * s["u"], -1) ** 2 + np.sum(offset * s["v"], -1) ** 2
        rho_plane = np.where(t > 0, rho_plane, np.inf)
        rho_screen = c.LOW_PASS_INV_VARIANCE * ((x - s["centre"][0]) ** 2 + (y - s["centre"][1]) ** 2)
        z = np.where(rho_screen < rho_plane, p[2], t)
        a = np.minimum(c.ALPHA_MAX, s["opacity"] * np.exp(-0.5 * np.minimum(rho_plane, rho_screen)))
        found.append((a, z, np.abs(rho_screen - rho_plane) < band * rho_screen))
    return found, order(surfels, camera)


def camera_surfels(raw: dict[str, Array], camera: PinholeCamera) -> dict[str, Array]:
    """Per surfel: centre p, tangents u and v over their σ, normal n (camera frame), projection, opacity.

    Culled surfels stay, with opacity 0.
    """
    to_camera, origin = camera.to_world[:3, :3].T, camera.to_world[:3, 3]
    centres = (raw["position"] - origin) @ to_camera.T
    axes = np.array([to_camera @ rotation_matrix(q) for q in raw["rotation"]]).reshape(-1, 3, 3)
    sigma = np.exp(raw["scale"])
    opacity = sigmoid(raw["opacity"][:, 0])
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


def order(surfels: dict[str, Array], camera: PinholeCamera) -> Array:
    """Surfel indices (N, H, W), front to back by the depth near the centre of each pixel's tile.

    With the ray (x, y, 1) through that centre, 1/z of a surfel's plane is (ray·n) / (p·n). The point on the
    plane is brought to within SORT_REACH σ of p along 1/z, which is linear across the screen.
    """
    p, n = surfels["p"], surfels["n"]
    shown = surfels["opacity"] > 0
    k = 1 / np.where(shown, p[:, 2], 1)
    pn = np.where(shown, np.sum(p * n, axis=1), 1)
    out = np.zeros((len(p), camera.height, camera.width), int)
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
            out[:, top : top + height, left : left + width] = ranked[:, None, None]
    return out
