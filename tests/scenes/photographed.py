"""Photographs of a patterned block on a patterned ground, ray traced in NumPy, with their cameras."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates, zoom

from mi_refgs.reference.camera import look_at

WIDTH, HEIGHT, FOCAL = 256, 192, 260.0
BLOCK = np.array([0.7, 0.5, 0.8])  # half widths and the height, whose bottom is at z = 0


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera: rotation from the world to right, down, forward, and its place."""

    rotation: np.ndarray
    origin: np.ndarray


def around(count: int, arc: float = 120.0, radius: float = 3.2, height: float = 1.6) -> list[Shot]:
    """Cameras on an arc of so many degrees, level, that look at the block."""
    shots = []
    for angle in np.radians(np.linspace(-arc / 2, arc / 2, count)):
        lift = height + 0.3 * np.sin(5 * angle)
        shots.append(look(np.array([radius * np.cos(angle), radius * np.sin(angle), lift])))
    return shots


def look(origin: np.ndarray, target: tuple[float, float, float] = (0.0, 0.0, 0.35)) -> Shot:
    pose = look_at(origin, np.array(target))  # left, up, forward
    return Shot((pose[:3, :3] * [-1, -1, 1]).T, origin)


def noise(seed: int, size: int = 512) -> np.ndarray:
    """A pattern of several scales, (size, size, 3) in 0 … 1."""
    rng = np.random.default_rng(seed)
    total = np.zeros((size, size, 3))
    for cells in (16, 48, 128):
        total += zoom(rng.random((cells, cells, 3)), (size / cells, size / cells, 1), order=1)
    return np.clip(0.5 + 1.2 * (total / 3 - 0.5), 0, 1)


PATTERNS = [noise(seed) for seed in range(4)]


def photograph(shot: Shot, k1: float = 0.0, samples: int = 1) -> np.ndarray:
    """The image (HEIGHT, WIDTH, 3) uint8 of a camera whose lens has the radial coefficient k1."""
    rows, columns = np.indices((HEIGHT * samples, WIDTH * samples))
    x = ((columns + 0.5) / samples - WIDTH / 2) / FOCAL
    y = ((rows + 0.5) / samples - HEIGHT / 2) / FOCAL
    u, v = x, y
    for _ in range(20):  # the direction that the lens moves to (x, y)
        factor = 1 + k1 * (u * u + v * v)
        u, v = x / factor, y / factor
    direction = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ shot.rotation
    colour, nearest = np.full((len(direction), 3), 0.6), np.full(len(direction), np.inf)
    planes = [(2, 0.0, 0, 8.0), (2, BLOCK[2], 1, 0.0), (0, BLOCK[0], 2, 0.0), (0, -BLOCK[0], 2, 0.0)]
    planes += [(1, BLOCK[1], 3, 0.0), (1, -BLOCK[1], 3, 0.0)]
    for axis, level, pattern, half in planes:
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (level - shot.origin[axis]) / direction[:, axis]
            hit = shot.origin + distance[:, None] * direction
            inside = (abs(hit[:, :2]) <= (half or BLOCK[:2] + 1e-9)).all(axis=1)
            inside &= hit[:, 2] < BLOCK[2] + 1e-9
            inside &= (hit[:, 2] > -1e-9) & (distance > 0) & (distance < nearest)
        a, b = (hit[inside][:, i] for i in range(3) if i != axis)
        texture = PATTERNS[pattern]
        at = np.stack([a, b]) / 3.0 * len(texture) % len(texture)
        for channel in range(3):
            colour[inside, channel] = map_coordinates(texture[..., channel], at, order=1, mode="wrap")
        nearest[inside] = distance[inside]
    image = colour.reshape(HEIGHT, samples, WIDTH, samples, 3).mean(axis=(1, 3))
    return np.round(image * 255).astype(np.uint8)


def save(path: Path, pixels: np.ndarray, **exif: Any) -> None:
    """A file of an image; `orientation`, `focal35`: EXIF."""
    path.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(pixels)
    data = Image.Exif()
    data[0x010F] = "Camera"  # without a tag of its own, the detail below would not be written
    if "orientation" in exif:
        data[0x0112] = exif["orientation"]
    if "focal35" in exif:
        data.get_ifd(0x8769)[0xA405] = exif["focal35"]
    image.save(path, exif=data, quality=95)
