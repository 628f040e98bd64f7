"""Dots in space as cameras of OpenCV's axes see them: a flipped axis or half a pixel moves them."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mi_refgs.data.lens import Lens
from mi_refgs.data.view import View
from mi_refgs.io.images import write_png
from mi_refgs.reference.camera import look_at

POINTS = np.random.default_rng(3).uniform(-0.5, 0.5, (9, 3))
COLOURS = np.random.default_rng(4).integers(60, 256, (9, 3))  # sRGB, 8 bits
SIGMA = 2.2  # pixels
DISTANCE = 3.0


@dataclass(frozen=True)
class Shot:
    """One camera and its image."""

    name: str
    index: int
    width: int = 96
    height: int = 72
    focal: tuple[float, float] = (110.0, 104.0)
    centre: tuple[float, float] = (50.3, 34.6)
    lens: Lens = field(default_factory=lambda: Lens(False, (0.0,)))

    @property
    def rotation(self) -> np.ndarray:
        """World to camera."""
        angle, height = 0.5 * self.index, 0.4 * np.sin(self.index)
        eye = np.array([np.cos(angle), height, np.sin(angle)])
        return (look_at(eye, np.zeros(3), (0.1, 1, 0))[:3, :3] * [-1, -1, 1]).T

    @property
    def translation(self) -> np.ndarray:
        """Translation of world points, after the rotation: the world's origin is in view, off the axis."""
        return np.array([0.05, -0.03, DISTANCE])

    @property
    def camera_to_world(self) -> np.ndarray:
        """(4, 4), OpenCV's axes."""
        matrix = np.eye(4)
        matrix[:3, :3], matrix[:3, 3] = self.rotation.T, -self.rotation.T @ self.translation
        return matrix

    def image(self) -> np.ndarray:
        """The dots through the lens: (H, W) 0 … 1."""
        x, y, z = self.rotation @ POINTS.T + self.translation[:, None]
        x, y = self.lens.distort(x / z, y / z)
        (fx, fy), (cx, cy) = self.focal, self.centre
        return dots(self.width, self.height, fx * x + cx, fy * y + cy, SIGMA)

    def write(self, folder: Path) -> Path:
        """The image as PNG."""
        (folder / self.name).parent.mkdir(parents=True, exist_ok=True)
        write_png(folder / self.name, np.repeat(self.image()[..., None], 3, axis=-1))
        return folder / self.name


def dots(width: int, height: int, across: np.ndarray, down: np.ndarray, sigma: float) -> np.ndarray:
    columns, rows = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    total = np.zeros((height, width))
    for u, v in zip(across, down, strict=True):
        total += np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * sigma**2))
    return np.clip(total, 0, 1)


def check(view: View, shot: Shot, tolerance: float = 0.03) -> None:
    """The view's image has the dots where the view's camera sees the points."""
    view = view.load()
    row, column, seen = view.project(POINTS)
    assert seen.sum() >= 7
    sigma = SIGMA * view.fx / shot.focal[0]
    expected = dots(view.width, view.height, column + 0.5, row + 0.5, sigma)
    assert np.abs(view.image[..., 0] - expected).max() < tolerance
    shifted = dots(view.width, view.height, column + 1, row + 0.5, sigma)
    assert np.abs(view.image[..., 0] - shifted).max() > 2 * tolerance  # half a pixel would be seen
