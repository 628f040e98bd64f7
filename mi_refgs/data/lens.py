"""Lens distortion: OpenCV's models, and resampling of images to those of a pinhole camera.

With (x, y) = direction / depth and r² = x² + y², a lens distorts the image of a point to

    perspective   x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p1 x y + p2 (r² + 2 x²)
                  y' = y (1 + k1 r² + k2 r⁴ + k3 r⁶) + 2 p2 x y + p1 (r² + 2 y²)
    fisheye       (x', y') = (x, y) θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸) / r,  θ = atan r

and to the pixel (fx x' + cx, fy y' + cy), where the centre of the first pixel is (½, ½)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from threading import Lock

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy import ndimage

from mi_refgs.errors import InputError

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")
MAX_ZOOM = 2.0  # factor of the focal length beyond which less than a quarter of the image would be left
GRID = 65  # points a side at which a zoom is checked; between them edges bend by less than 0.01 pixels
ROWS = 64  # rows of an image whose source pixels are computed together
_lock = Lock()


@dataclass(frozen=True)
class Lens:
    """Distortion coefficients."""

    fisheye: bool
    radial: tuple[float, ...]  # k1, k2, k3, k4; a perspective lens has no k4
    tangential: tuple[float, float] = (0.0, 0.0)  # p1, p2

    @staticmethod
    def of(fisheye: bool, given: Mapping[str, float]) -> "Lens | None":
        """The lens with the given coefficients, 0 where absent; None for a pinhole."""
        k1, k2, k3, k4, p1, p2 = (given.get(name, 0.0) for name in COEFFICIENTS)
        if not (fisheye or any((k1, k2, k3, p1, p2))):
            return None
        return Lens(fisheye, (k1, k2, k3, k4) if fisheye else (k1, k2, k3), (p1, p2))

    @property
    def model(self) -> str:
        """Name in COLMAP, whose OPENCV has no k3, and nerfstudio."""
        return "OPENCV_FISHEYE" if self.fisheye else "OPENCV"

    @property
    def coefficients(self) -> dict[str, float]:
        """The coefficients by name: k1, k2 …, and p1, p2 of a perspective lens."""
        radial = {f"k{i}": k for i, k in enumerate(self.radial, 1)}
        return radial if self.fisheye else radial | dict(zip(("p1", "p2"), self.tangential, strict=True))

    def distort(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distort image points (x, y) at unit distance."""
        square, series = x * x + y * y, (1, *self.radial)
        if self.fisheye:
            r = np.sqrt(square)
            angle = np.arctan(r)
            factor = np.where(r > 0, angle / np.where(r > 0, r, 1), 1) * polyval(angle * angle, series)
            return x * factor, y * factor
        factor, (p1, p2) = polyval(square, series), self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + 2 * p2 * x * y + p1 * (square + 2 * y * y),
        )


@dataclass(frozen=True)
class Undistortion:
    """Resampling of images of one lens: same size and principal point, focal length × zoom. The zoom is the
    smallest from 1 on for which every pixel of the result has data."""

    lens: Lens
    camera: tuple[int, int, float, float, float, float]  # width, height, fx, fy, cx, cy; distorted image
    zoom: float

    def resample(self, image: np.ndarray, order: int = 3) -> np.ndarray:
        """Undistort an (H, W, C) image by splines of `order`, clipped to the range of each channel."""
        with _lock:  # else several threads would compute the same coordinates
            coordinates = _source_coordinates(self)
        result = np.empty((*coordinates.shape[1:], image.shape[-1]), image.dtype)
        for i, plane in enumerate(np.moveaxis(image, -1, 0)):
            moved = ndimage.map_coordinates(plane, coordinates, order=order, mode="nearest")
            result[..., i] = np.clip(moved, plane.min(), plane.max())
        return result

    def source(self, columns: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Columns and rows in the distorted image of those in the result; 0 is the first pixel's centre."""
        _, _, fx, fy, cx, cy = self.camera
        x, y = (columns + 0.5 - cx) / (self.zoom * fx), (rows + 0.5 - cy) / (self.zoom * fy)
        x, y = self.lens.distort(x, y)
        return fx * x + cx - 0.5, fy * y + cy - 0.5


@lru_cache(maxsize=2)
def _source_coordinates(straight: Undistortion) -> np.ndarray:
    """Row and column in the distorted image, (2, H, W) float32, of every pixel of the result."""
    width, height = straight.camera[:2]
    coordinates = np.empty((2, height, width), dtype=np.float32)
    for start in range(0, height, ROWS):  # all at once would take ten times the memory
        rows = np.arange(start, min(start + ROWS, height), dtype=float)
        columns, lines = straight.source(*np.meshgrid(np.arange(width, dtype=float), rows))
        coordinates[:, start : start + ROWS] = lines, columns
    return coordinates


@lru_cache(maxsize=4)
def undistortion(
    lens: Lens, width: int, height: int, fx: float, fy: float, cx: float, cy: float
) -> Undistortion:
    """The resampling of images; raises InputError where no zoom up to MAX_ZOOM gives every pixel data."""
    camera = (width, height, fx, fy, cx, cy)
    across, down = np.meshgrid(np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID))
    step = 1e-3  # pixels, for the derivatives

    def valid(zoom: float) -> bool:
        """Whether the source pixels are inside the distorted image and the lens does not fold it."""
        source = Undistortion(lens, camera, zoom).source
        u, v = source(across, down)
        right, below = source(across + step, down), source(across, down + step)
        turn = (right[0] - u) * (below[1] - v) - (right[1] - v) * (below[0] - u)
        inside = min(u.min(), v.min(), width - 1 - u.max(), height - 1 - v.max()) >= -step
        return bool(inside and turn.min() > 0)

    with np.errstate(over="ignore", invalid="ignore"):  # coefficients may be anything; NaN is not valid
        low, high = 1.0, MAX_ZOOM
        if not valid(high):
            what = "the distortion moves the image's edges more than half-way in, or folds it"
            raise InputError(what, remedy="correct the coefficients")
        high = low if valid(low) else high
        for _ in range(30 if high > low else 0):  # to 1e-9 of the focal length, 1e-6 pixels
            middle = (low + high) / 2
            low, high = (low, middle) if valid(middle) else (middle, high)
    return Undistortion(lens, camera, high)
