"""One image of a data set with its camera, in NumPy."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mi_refgs.data.images import OVERSHOOT, ImageSource, Mask, Pixels
from mi_refgs.data.lens import Lens
from mi_refgs.errors import InputError
from mi_refgs.io.images import box_downscale, linear_from_srgb, srgb_from_linear

if TYPE_CHECKING:
    from mi_refgs.splat.camera import Camera

FAINTEST = 1e-3  # by which colour is divided at least: 8 bits do not resolve fainter pixels


@dataclass(frozen=True)
class FileCamera:
    """An image file as it is on disk, and the lens through which it was taken."""

    path: Path
    width: int  # pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the file
    lens: Lens | None = None  # None: a pinhole
    mask: Mask | None = None


@dataclass(frozen=True, eq=False)
class View:
    """One image and its camera; `load` it before `image`, `alpha` and what depends on them."""

    name: str
    width: int  # pixels
    height: int  # pixels
    fx: float  # focal length, pixels, positive
    fy: float
    cx: float  # principal point, pixels from the left edge; the centre is width / 2
    cy: float
    to_world: np.ndarray  # (4, 4) float64, rigid, from Mitsuba's camera frame: +z forward, +x left, +y up
    pixels: Pixels | ImageSource = field(repr=False)
    normal: np.ndarray | None = None  # (H, W, 3) float32, world space, 0 off the object
    depth: np.ndarray | None = None  # (H, W) float32 along the viewing axis, 0 off the object
    is_linear_radiance: bool = False  # of `image`: EXR; else it is sRGB-encoded
    materials: dict[str, np.ndarray] = field(default_factory=dict)
    """Known ones of albedo, roughness, metallic: (H, W, C + 1) float32, the last the fraction of the pixel
    that the others describe."""
    near: float = 0.0  # depth of the near plane, scene units; `read_dataset` derives it from all cameras
    file: FileCamera | None = None  # from which the image was read
    tracks: np.ndarray | None = field(default=None, repr=False)
    """(K, 5) column and row of keypoints in pixels of that file, 0 at its corner, and their points, world."""

    def load(self) -> "View":
        """The view with its image decoded; raises InputError for an unreadable file, another size, and values
        of 8 bits."""
        if isinstance(self.pixels, ImageSource):
            return replace(self, pixels=self.pixels.read()).load()
        for name, pixels, channels in (("image", self.pixels.image, (3,)), ("alpha", self.pixels.alpha, ())):
            shape = (self.height, self.width, *channels)
            if pixels is not None and np.shape(pixels) != shape:
                what, remedy = f"{name} has shape {np.shape(pixels)}", f"give {shape}, the size of the view"
                raise InputError(what, self.name, "pixels", remedy)
            linear = name == "image" and self.is_linear_radiance
            if pixels is not None and not linear and (most := np.max(pixels, initial=0)) > 1 + OVERSHOOT:
                remedy = "give 0 … 1, not 0 … 255; radiance with `is_linear_radiance`"
                raise InputError(f"{name} has {most:g}", self.name, "pixels", remedy)
        return self

    @property
    def has_alpha(self) -> bool:
        """The view need not be loaded."""
        return self.pixels.has_alpha

    @property
    def image(self) -> np.ndarray:
        """The target (H, W, 3) float32, composited onto the background."""
        return self._loaded("image").image

    @property
    def alpha(self) -> np.ndarray | None:
        """Alpha (H, W) float32; None without any."""
        return self._loaded("alpha").alpha if self.has_alpha else None

    def _loaded(self, name: str) -> Pixels:
        if isinstance(self.pixels, ImageSource):
            raise RuntimeError(f"view '{self.name}' is not loaded; use view.load().{name}")
        return self.pixels

    @property
    def displayed(self) -> np.ndarray:
        """The image (H, W, 3), sRGB-encoded."""
        return srgb_from_linear(self.image) if self.is_linear_radiance else self.image

    def camera(self) -> "Camera":
        """The splatter's camera; in Mitsuba's frame both of its focal lengths are negative."""
        from mi_refgs.splat.camera import Camera

        focal = (-self.fx, -self.fy)
        return Camera.from_pose(self.width, self.height, *focal, self.cx, self.cy, self.to_world, self.near)

    def covered(self) -> np.ndarray:
        """Coverage of pixels by the object, (H, W): alpha, or whether ground truth has a surface, or 1."""
        if self.alpha is not None:
            return self.alpha
        if self.normal is not None:
            return np.any(self.normal != 0, axis=-1).astype(np.float32)
        if self.depth is not None:
            return (self.depth > 0).astype(np.float32)
        return np.ones((self.height, self.width), np.float32)

    def averaged(self, block: int) -> "View":
        """The loaded view averaged over `block`² pixels, without maps; InputError if it is smaller."""
        if min(self.width, self.height) < block:
            what = f"{self.width} × {self.height} pixels are less than a block of {block}²"
            raise InputError(what, self.name, "data.coarse", "give a smaller one")
        loaded = self.load()
        alpha = None if loaded.alpha is None else box_downscale(loaded.alpha[..., None], block)[..., 0]
        pinhole = {name: getattr(self, name) / block for name in ("fx", "fy", "cx", "cy")}
        pixels = Pixels(box_downscale(loaded.image, block), alpha)
        averaged = replace(self, width=self.width // block, height=self.height // block, **pinhole)
        return replace(averaged, pixels=pixels, normal=None, depth=None, materials={})

    def colour(self, background: np.ndarray) -> np.ndarray:
        """Linear colour (H, W, 3) of the object, not premultiplied; `background` (3,) as in `image`."""
        alpha = np.float32(1) if self.alpha is None else self.alpha[..., None]
        colour = np.clip((self.image - (1 - alpha) * background) / np.maximum(alpha, FAINTEST), 0, None)
        return colour if self.is_linear_radiance else linear_from_srgb(np.clip(colour, 0, 1))

    def depth_of(self, points: np.ndarray) -> np.ndarray:
        """Depth (...) of world points (..., 3) along the viewing axis."""
        return np.asarray((points - self.to_world[:3, 3]) @ self.to_world[:3, 2])

    def rays(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """World vectors (..., 3) from the camera to the points at depth 1 of pixels; integers are centres."""
        x, y = (self.cx - 0.5 - column) / self.fx, (self.cy - 0.5 - row) / self.fy
        return np.asarray(np.stack([x, y, np.ones_like(x)], axis=-1) @ self.to_world[:3, :3].T)

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Project world points (N, 3): row, column (N,), integer at pixel centres; whether in view (N,)."""
        local = (points - self.to_world[:3, 3]) @ self.to_world[:3, :3]
        depth = np.where(local[:, 2] > 0, local[:, 2], np.inf)
        column = -self.fx * local[:, 0] / depth + self.cx - 0.5
        row = -self.fy * local[:, 1] / depth + self.cy - 0.5
        in_view = (local[:, 2] > 0) & (abs(column - (self.width - 1) / 2) <= self.width / 2)
        return row, column, in_view & (abs(row - (self.height - 1) / 2) <= self.height / 2)


def evenly_spread(length: int, most: int) -> list[int]:
    """Indices of at most `most` items of a sequence, evenly spread, the first and the last among them."""
    return [int(i) for i in np.linspace(0, length - 1, min(most, length)).round()]
