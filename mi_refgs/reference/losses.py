"""Losses, depth normals and Adam in float64; images are (H, W, 3), planes (H, W)."""

import math

import numpy as np
from scipy.ndimage import correlate1d, gaussian_filter

from mi_refgs.reference.light import Array, radiance_of


def srgb(linear: Array) -> Array:
    """sRGB encoding (IEC 61966-2-1), unbounded above."""
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, curve)


def display_image(radiance: Array, alpha: Array, background: tuple[float, float, float]) -> Array:
    """A srgb(L / A) + (1 - A) background; the background alone where A < 1e-6."""
    a = alpha[..., None]
    shown = np.where(a >= 1e-6, a * srgb(radiance / np.where(a >= 1e-6, a, 1)), 0)
    return shown + (1 - a) * np.array(background)


def l1(image: Array, target: Array, clipped: Array | bool = False) -> float:
    """Mean absolute difference; where `clipped`, an image above the target is no error."""
    return float(np.mean(np.where(clipped & (image > target), 0, np.abs(image - target))))


def ssim(image: Array, target: Array) -> float:
    """Mean SSIM: 11×11 Gaussian window with σ = 1.5, zeros outside the image, C1 = 1e-4, C2 = 9e-4."""

    def mean(values: Array) -> Array:
        # Cut at 5 pixels; of weights that sum to 1.
        return gaussian_filter(values, 1.5, mode="constant", radius=5, axes=(0, 1))

    μx, μy = mean(image), mean(target)
    σx2, σy2 = mean(image**2) - μx**2, mean(target**2) - μy**2
    σxy = mean(image * target) - μx * μy
    total = (2 * μx * μy + 1e-4) * (2 * σxy + 9e-4) / ((μx**2 + μy**2 + 1e-4) * (σx2 + σy2 + 9e-4))
    return float(total.mean())


def normals_from_depth(
    depth: Array, alpha: Array, fx: float, fy: float, cx: float, cy: float, world_from_camera: Array
) -> tuple[Array, Array]:
    """World normals (H, W, 3) of a camera-depth map by central differences, and their validity (H, W): not at
    steps between surfaces, which the viewing ray meets at a cosine of at most 0.2."""
    height, width = depth.shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    ray = np.stack([(x - cx) / fx, (y - cy) / fy, np.ones_like(x)], axis=-1)
    point, inner = depth[..., None] * ray, np.s_[1:-1, 1:-1]
    normal = np.cross(point[1:-1, 2:] - point[1:-1, :-2], point[2:, 1:-1] - point[:-2, 1:-1])
    length = np.linalg.norm(normal, axis=-1)
    cosine = np.abs(np.sum(normal * ray[inner], axis=-1))
    seen = alpha >= 1 / 255
    seen = seen[inner] & seen[1:-1, :-2] & seen[1:-1, 2:] & seen[:-2, 1:-1] & seen[2:, 1:-1]
    normals, valid = np.zeros((height, width, 3)), np.zeros((height, width), bool)
    valid[inner] = seen & (length**2 > 1e-20) & (cosine > 0.2 * length * np.linalg.norm(ray[inner], axis=-1))
    away = np.sum(normal * point[inner], axis=-1, keepdims=True) > 0
    unit = np.where(away, -normal, normal) / np.where(length > 0, length, 1)[..., None]
    normals[inner] = np.where(valid[inner][..., None], unit @ world_from_camera.T, 0)
    return normals, valid


def normal_consistency(
    normal: Array, depth_normal: Array, valid: Array, weight: Array, share: Array | None = None
) -> float:
    """Mean over all pixels of A (a - N · n_d) where n_d is valid; `weight` is the constant A, a the share."""
    covered = weight if share is None else share
    return float(np.mean(np.where(valid, weight * (covered - np.sum(normal * depth_normal, axis=-1)), 0)))


def smoothness(maps: Array, image: Array, edge: float = 1.0) -> float:
    """Mean over pixels of Σ_axis ‖∂M‖ exp(-edge ‖∂I‖), ‖·‖ the mean absolute value of the planes."""

    def slope(values: Array, axis: int) -> Array:
        across = correlate1d(values, [1, 2, 1], 1 - axis, mode="nearest")
        return np.mean(np.abs(correlate1d(across, [-1, 0, 1], axis, mode="nearest") / 8), axis=-1)

    return float(np.mean(sum(slope(maps, axis) * np.exp(-edge * slope(image, axis)) for axis in (0, 1))))


def undecided(value: Array, alpha: Array) -> float:
    """Mean over pixels of A x (1 - x)."""
    return float(np.mean(alpha * value * (1 - value)))


def irradiances(level: Array) -> Array:
    """Colours (256, 3) of an irradiance map in the directions of a spherical Fibonacci lattice around y."""
    i = np.arange(256)
    z = 1 - (2 * i + 1) / 256
    φ, ring = i * math.pi * (3 - math.sqrt(5)), np.sqrt(1 - z * z)
    return radiance_of(level, np.stack([ring * np.cos(φ), ring * np.sin(φ), z], axis=1))


def light_colour(level: Array, scale: float) -> float:
    """Mean over directions of the mean |E - grey E| of the channels, over `scale`, which is a constant."""
    irradiance = irradiances(level)
    return float(np.mean(np.abs(irradiance - irradiance.mean(1, keepdims=True))) / scale)


def light_difference(
    radiance: Array, photographed: Array, seen: Array, area: Array, clipped: float, hue: float
) -> float:
    """Mean over channels and directions (N, …) of |d| where seen, and of the deviation from the mean d."""
    off = np.log((1 + radiance) / (1 + photographed))
    dark = np.where((photographed > clipped) & (off > 0), 0, np.abs(off))
    colour = np.abs(off - off.mean(axis=1, keepdims=True))
    each = seen[:, None] * dark + hue * (1 - seen[:, None]) * colour
    return float(np.sum(area[:, None] * each) / 3)


def adam(parameter: Array, gradients: list[Array], rates: list[Array | float]) -> Array:
    """Adam in the form of its Algorithm 1 (bias-corrected moments); ε = 1e-15 as in the efficient order."""
    θ, m, v = parameter.astype(np.float64), np.zeros(parameter.shape), np.zeros(parameter.shape)
    for t, (g, rate) in enumerate(zip(gradients, rates, strict=True), start=1):
        m = 0.9 * m + 0.1 * g
        v = 0.999 * v + 0.001 * g**2
        corrected_m, corrected_v = m / (1 - 0.9**t), v / (1 - 0.999**t)
        θ = θ - rate * corrected_m / (np.sqrt(corrected_v) + 1e-15 / math.sqrt(1 - 0.999**t))
    return θ
