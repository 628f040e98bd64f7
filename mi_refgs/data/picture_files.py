"""Where a picture lies, and how its file becomes the pixels of a view: one way for every reader.

A file is decoded, its colour multiplied by alpha (its own, or a mask's), averaged over blocks of `downscale`
pixels squared, resampled without the lens and laid onto the background. The rows and columns of the file
count as they lie there: an orientation in its EXIF data turns nothing, as in COLMAP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.exposure import log_exposure
from mi_refgs.data.lens import Lens, Undistortion, undistortion
from mi_refgs.data.picture_store import Picture
from mi_refgs.data.readers import ReadOptions
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.exr import exr_has_alpha, read_exr_image
from mi_refgs.io.images import box_downscale, has_alpha, image_size, read_bytes, read_grey, read_mask

BAND = 256
"""Rows of a file that are floating-point numbers at a time: a large picture would need half a gigabyte."""


@dataclass(frozen=True)
class Mask:
    """A picture of the size of another that says where the object is."""

    path: Path
    below: int | None = None
    """Without it, alpha is that of `read_mask`. With it, alpha is 1 where the file's own number, such as a
    depth of 16 bits, is less, and 0 elsewhere."""

    def read(self) -> np.ndarray:
        """Alpha (H, W) float32."""
        if self.below is not None:
            return (read_grey(self.path)[0] < self.below).astype(np.float32)
        return read_mask(self.path)


@dataclass(frozen=True)
class FileCamera:
    """An image file as it is on disk, and the lens through which it was taken."""

    path: Path
    width: int  # pixels
    height: int
    intrinsics: tuple[float, float, float, float]  # fx, fy, cx, cy in pixels of the file
    lens: Lens | None = None  # None: a pinhole
    mask: Mask | None = None


@dataclass(frozen=True)
class PictureFile:
    """A picture in a file, and what is done to it."""

    path: Path
    width: int  # pixels, of the file
    height: int
    downscale: int = 1
    mask: Mask | None = None
    straight: Undistortion | None = None  # of the averaged picture

    @classmethod
    def find(cls, path: Path, downscale: int, mask: Mask | None = None) -> PictureFile:
        """The picture in a file, of which only the header is read.

        Raises InputError for a file that cannot be used, and for one of less than a block of pixels.
        """
        width, height = image_size(path)
        if min(width, height) < downscale:
            raise InputError(
                f"{path}: downscale: {width} × {height} pixels are less than a block of {downscale}²; "
                "give a smaller number"
            )
        return cls(path, width, height, downscale, mask)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the view's picture."""
        return self.width // self.downscale, self.height // self.downscale

    def read(self, background: float) -> tuple[np.ndarray, np.ndarray | None]:
        """Colour (H, W, 3) on the background and alpha (H, W) or None, float32; sRGB, or linear from EXR.

        Raises InputError for a file that cannot be read, or a mask of another size.
        """
        return self.planes(self.decode(), background)

    @property
    def largest(self) -> int:
        """Bytes that `decode` gives at most."""
        width, height = self.size
        return 4 * width * height * (1 if self._as_it_is else 4)

    @property
    def _as_it_is(self) -> bool:
        """Whether the view shows the numbers of the file."""
        changed = self.downscale > 1 or self.mask is not None or self.straight is not None
        return not changed and self.path.suffix.lower() != ".exr"

    def has_alpha(self) -> bool:
        """Whether there is alpha, by the file's header."""
        if self.path.suffix.lower() == ".exr":
            return self.mask is not None or exr_has_alpha(self.path)
        return self.mask is not None or has_alpha(self.path)

    def decode(self) -> np.ndarray:
        """What `planes` needs of the file (H, W, 3 or 4): its 8-bit numbers if nothing is done to them, else
        float32, premultiplied.

        Raises InputError for a file that cannot be read, or a mask of another size.
        """
        if self._as_it_is:
            return read_bytes(self.path)[0]
        small = self._averaged()
        return small if self.straight is None else self.straight.resample(small)

    def planes(self, decoded: np.ndarray, background: float) -> tuple[np.ndarray, np.ndarray | None]:
        """Colour and alpha, as `read` gives them, of what `decode` gave."""
        small = decoded
        if small.dtype == np.uint8:
            small = small.astype(np.float32) / np.float32(255)
            if small.shape[-1] == 4:
                small[..., :3] *= small[..., 3:]
        colour = np.array(small[..., :3])
        if small.shape[-1] == 3:
            return colour, None
        alpha = np.array(small[..., 3])
        colour += (1 - alpha[..., None]) * np.float32(background)
        return colour, alpha

    def _averaged(self) -> np.ndarray:
        """Premultiplied colour, with alpha where there is one, of the averaged picture."""
        linear = self.path.suffix.lower() == ".exr"
        if linear:
            pixels, factor = read_exr_image(self.path), 1
            if pixels.shape[-1] < 3:
                raise InputError(f"{self.path}: channels: no R, G, B; export a colour picture")
        else:
            pixels, factor = read_bytes(self.path, 1 if self.mask else self.downscale)
        mask = self._mask()
        width, height = self.size
        block = self.downscale // factor
        bands, step = [], max(BAND // block, 1)
        for top in range(0, height, step):
            rows = slice(top * block, min(top + step, height) * block)
            band = pixels[rows, : width * block]
            if not linear:
                band = band.astype(np.float32) / np.float32(255)
            if mask is not None:
                covered = mask[rows, : width * block, None]
                covered = covered * band[..., 3:] if band.shape[-1] == 4 else covered
                band = np.concatenate([band[..., :3], covered], axis=-1)
            if band.shape[-1] == 4 and (mask is not None or not linear):
                band[..., :3] *= band[..., 3:]
            bands.append(box_downscale(band, block))
        return np.concatenate(bands)

    def _mask(self) -> np.ndarray | None:
        """Alpha from the mask, at the file's size."""
        if self.mask is None:
            return None
        alpha = self.mask.read()
        if alpha.shape != (self.height, self.width):
            raise InputError(
                f"{self.mask.path}: mask: {alpha.shape[1]} × {alpha.shape[0]} pixels, but {self.path.name} "
                f"has {self.width} × {self.height}; make both of one size"
            )
        return alpha


def make_view(
    name: str,
    picture: PictureFile,
    options: ReadOptions,
    intrinsics: tuple[float, float, float, float],
    lens: Lens | None,
    to_world: np.ndarray,
    where: str,
) -> tuple[View, Undistortion | None]:
    """The view of a picture, and how maps of the averaged picture's size are undistorted like it.

    `intrinsics` are fx, fy, cx, cy in pixels of the file; `to_world` as in `View`. Raises InputError, which
    begins with `where`, for a focal length that no camera has and for a lens that cannot be undone.
    """
    for focal in intrinsics[:2]:
        if not 1 / MAX_NUMBER <= focal <= MAX_NUMBER:
            raise InputError(f"{where}: focal length: {focal:.3g} pixels is out of range; correct it")
    file = FileCamera(picture.path, picture.width, picture.height, intrinsics, lens, picture.mask)
    width, height = picture.size
    fx, fy, cx, cy = (value / picture.downscale for value in intrinsics)
    straight = None
    if lens is not None:
        try:
            straight = undistortion(lens, width, height, fx, fy, cx, cy)
        except InputError as error:
            raise InputError(f"{where}: k1 … p2: {error}") from None
        fx, fy = fx * straight.zoom, fy * straight.zoom
        picture = replace(picture, straight=straight)
    pixels: Any = Picture(picture, options.background, decode=options.decode)
    alpha = pixels if pixels.has_alpha else None
    exposure = log_exposure(picture.path)
    linear = options.images == "exr"
    view = View(name, width, height, fx, fy, cx, cy, to_world, pixels, alpha, None, None, linear)
    return view.changed(exposure=exposure, file=file), straight
