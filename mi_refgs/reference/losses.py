"""Losses, depth normals, Adam, relocation and antialiased roughness in float64, pixel by pixel.

Images are (H, W, 3), planes (H, W); row first. No helper is shared with the fast path.
"""

from __future__ import annotations

import math

import numpy as np

from mi_refgs.reference.light import radiance_of


def srgb(linear: float) -> float:
    """sRGB encoding of one value (IEC 61966-2-1), unbounded above."""
    return 12.92 * linear if linear <= 0.0031308 else 1.055 * linear ** (1 / 2.4) - 0.055


def display_image(
    radiance: np.ndarray, alpha: np.ndarray, background: tuple[float, float, float]
) -> np.ndarray:
    """A srgb(L / A) + (1 - A) background; the background alone where A < 1e-6."""
    out = np.empty_like(radiance)
    for index in np.ndindex(radiance.shape):
        a = alpha[index[:2]]
        shown = a * srgb(radiance[index] / a) if a >= 1e-6 else 0.0
        out[index] = shown + (1 - a) * background[index[2]]
    return out


def l1(image: np.ndarray, target: np.ndarray, clipped: np.ndarray | None = None) -> float:
    """Mean absolute difference; where `clipped`, an image above the target is no error."""
    total = 0.0
    for index in np.ndindex(image.shape):
        if clipped is None or not (clipped[index] and image[index] > target[index]):
            total += abs(image[index] - target[index])
    return total / image.size


def ssim(image: np.ndarray, target: np.ndarray) -> float:
    """Mean SSIM: 11×11 Gaussian window with σ = 1.5, zeros outside the image, C1 = 1e-4, C2 = 9e-4."""
    height, width, channels = image.shape
    weights = np.array([math.exp(-((k - 5) ** 2) / (2 * 1.5**2)) for k in range(11)])
    window = np.outer(weights, weights) / weights.sum() ** 2
    x_padded, y_padded = (np.pad(array, ((5, 5), (5, 5), (0, 0))) for array in (image, target))
    total = 0.0
    for row, column, channel in np.ndindex(height, width, channels):
        x = x_padded[row : row + 11, column : column + 11, channel]
        y = y_padded[row : row + 11, column : column + 11, channel]
        μx, μy = np.sum(window * x), np.sum(window * y)
        σx2, σy2 = np.sum(window * x * x) - μx**2, np.sum(window * y * y) - μy**2
        σxy = np.sum(window * x * y) - μx * μy
        total += (2 * μx * μy + 1e-4) * (2 * σxy + 9e-4) / ((μx**2 + μy**2 + 1e-4) * (σx2 + σy2 + 9e-4))
    return float(total / image.size)


def alpha_loss(alpha: np.ndarray, target: np.ndarray) -> float:
    """Mean absolute difference."""
    total = 0.0
    for index in np.ndindex(alpha.shape):
        total += abs(float(alpha[index]) - float(target[index]))
    return total / alpha.size


def normals_from_depth(
    depth: np.ndarray,
    alpha: np.ndarray,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    world_from_camera: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """World normals (H, W, 3) of a camera-depth map and their validity (H, W), by central differences.

    Steps between two surfaces, which the viewing ray meets at a cosine of at most 0.2, are not valid.
    """
    height, width = depth.shape
    normals, valid = np.zeros((height, width, 3)), np.zeros((height, width), dtype=bool)

    def point(row: int, column: int) -> np.ndarray:
        return depth[row, column] * np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])

    for row in range(1, height - 1):
        for column in range(1, width - 1):
            cross = [
                (row, column),
                (row, column - 1),
                (row, column + 1),
                (row - 1, column),
                (row + 1, column),
            ]
            if min(alpha[place] for place in cross) < 1 / 255:
                continue
            normal = np.cross(
                point(row, column + 1) - point(row, column - 1),
                point(row + 1, column) - point(row - 1, column),
            )
            if np.dot(normal, normal) <= 1e-20:
                continue
            ray = np.array([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, 1.0])
            if abs(np.dot(normal, ray)) <= 0.2 * np.linalg.norm(normal) * np.linalg.norm(ray):
                continue
            normal = -normal if np.dot(normal, point(row, column)) > 0 else normal
            normals[row, column] = world_from_camera @ (normal / np.linalg.norm(normal))
            valid[row, column] = True
    return normals, valid


def normal_consistency(
    normal: np.ndarray, depth_normal: np.ndarray, valid: np.ndarray, weight: np.ndarray
) -> float:
    """Mean over all pixels of A (A - N · n_d) where n_d is valid; `weight` is the constant A."""
    total = 0.0
    for index in np.ndindex(valid.shape):
        if valid[index]:
            total += weight[index] * (weight[index] - np.dot(normal[index], depth_normal[index]))
    return float(total / valid.size)


def smoothness(maps: np.ndarray, image: np.ndarray, edge: float = 1.0) -> float:
    """Mean over pixels of Σ_axis ‖∂M‖ exp(-edge ‖∂I‖), ‖·‖ the mean absolute value of the planes."""
    height, width, _ = maps.shape
    kernel = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]]) / 8
    padded = [np.pad(array, ((1, 1), (1, 1), (0, 0)), mode="edge") for array in (maps, image)]
    total = np.float64(0)
    for row, column in np.ndindex(height, width):
        for stencil in (kernel, kernel.T):
            bend, step = (
                np.mean(np.abs(np.tensordot(stencil, p[row : row + 3, column : column + 3]))) for p in padded
            )
            total += bend * math.exp(-edge * step)
    return float(total / (height * width))


def half_metal(metallic: np.ndarray, alpha: np.ndarray) -> float:
    """Mean over pixels of A m (1 - m)."""
    return float(np.mean(alpha * metallic * (1 - metallic)))


def _irradiances(level: np.ndarray, count: int = 256) -> np.ndarray:
    """Colours (count, 3) of an irradiance map in the directions of a spherical Fibonacci lattice around y."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    φ, ring = i * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - z * z)
    return radiance_of(level, np.stack([ring * np.cos(φ), ring * np.sin(φ), z], axis=1))


def mean_irradiance(level: np.ndarray) -> float:
    """Mean over directions and channels of an irradiance map (h, 2h, 3)."""
    return float(_irradiances(level).mean())


def light_colour(level: np.ndarray, scale: float) -> float:
    """Mean over directions of the mean |E - grey E| of the channels, over `scale`, which is a constant."""
    irradiance = _irradiances(level)
    return float(np.mean(np.abs(irradiance - irradiance.mean(1, keepdims=True))) / scale)


def adam(
    parameter: np.ndarray,
    gradients: list[np.ndarray],
    rates: list[np.ndarray | float],
    epsilon: float = 1e-15,
) -> np.ndarray:
    """Adam in the form of its Algorithm 1 (bias-corrected moments); ε as in the efficient order."""
    θ, m, v = parameter.astype(np.float64), np.zeros(parameter.shape), np.zeros(parameter.shape)
    for t, (g, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g**2
        corrected_m, corrected_v = m / (1 - 0.9**t), v / (1 - 0.999**t)
        θ = θ - rate * corrected_m / (np.sqrt(corrected_v) + epsilon / math.sqrt(1 - 0.999**t))
    return θ


def widened_roughness(roughness: np.ndarray, normal: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Maps (H, W), (H, W, 3), (H, W); as `render.antialias.widened`."""
    height, width = alpha.shape
    out = np.array(roughness, np.float64)
    for y in range(height):
        for x in range(width):
            if alpha[y, x] <= 1e-3:
                continue
            own = normal[y, x] / np.linalg.norm(normal[y, x])
            total = 0.0
            for steps in (((-1, 0), (1, 0)), ((0, -1), (0, 1))):
                turns = []
                for dx, dy in steps:
                    i, j = x + dx, y + dy
                    if 0 <= i < width and 0 <= j < height and alpha[j, i] > 1e-3:
                        other = normal[j, i] / np.linalg.norm(normal[j, i])
                        turns.append(float(np.sum((own - other) ** 2)))
                total += min(turns, default=0.0)
            out[y, x] = min(roughness[y, x] ** 4 + min(total / 12, 0.18), 1.0) ** 0.25
    return out


def relocated(opacity: float, number: int) -> tuple[float, float]:
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
