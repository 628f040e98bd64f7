"""Images of a data set: where their files are, how a file becomes an image of a view, and a bounded cache. A
file is decoded, its colour multiplied by alpha (its own, or that of a mask), averaged over blocks of pixels,
undistorted and composited onto the background. An orientation in EXIF data is ignored, as in COLMAP."""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_refgs.data.lens import Undistortion
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.exr import exr_has_alpha, read_exr_image
from mi_refgs.io.files import inside, is_file
from mi_refgs.io.images import (
    ENDINGS,
    box_downscale,
    has_alpha,
    image_size,
    read_bytes,
    read_grey,
    read_mask,
    with_ending,
)

CACHE_BYTES = 2**30  # of decoded images that a data set keeps: 28 of 12 Mpx, a thousand of 600 × 600
BAND = 256  # rows of a file that are converted to floating point at a time, for less memory
IMAGES, MASKS = "images", "masks"  # names of folders
COPIES = ("images_2", "images_4", "images_8")  # folders of smaller copies, the largest first


@dataclass(frozen=True)
class Mask:
    """An image that says where the object is, of the size of another image."""

    path: Path
    below: int | None = None  # if given, alpha is 1 where the file's number (a 16-bit depth) is less, else 0

    def read(self) -> np.ndarray:
        """Alpha (H, W) float32."""
        if self.below is None:
            return read_mask(self.path)
        return (read_grey(self.path)[0] < self.below).astype(np.float32)


@dataclass(frozen=True)
class ImageFile:
    """An image file, and how it becomes the image of a view."""

    path: Path
    width: int  # pixels, of the file
    height: int
    downscale: int = 1
    mask: Mask | None = None
    undistortion: Undistortion | None = None  # of the averaged image

    @classmethod
    def of(cls, path: Path, downscale: int, mask: Mask | None = None) -> ImageFile:
        """The image in a file, of which only the header is read."""
        width, height = image_size(path)
        if min(width, height) < downscale:
            what = f"{width} × {height} pixels are less than a block of {downscale}²"
            raise InputError(what, path, "downscale", "give a smaller number")
        return cls(path, width, height, downscale, mask)

    @property
    def size(self) -> tuple[int, int]:
        """Of the view's image."""
        return self.width // self.downscale, self.height // self.downscale

    @property
    def is_linear_radiance(self) -> bool:
        return self.path.suffix.lower() == ".exr"

    def has_alpha(self) -> bool:
        """Whether there is alpha, by the file's header."""
        header = exr_has_alpha if self.is_linear_radiance else has_alpha
        return self.mask is not None or header(self.path)

    def decode(self) -> np.ndarray:
        """(H, W, 3 or 4): uint8 as in the file, else float32, averaged and premultiplied."""
        linear, factor = self.is_linear_radiance, 1
        if linear:
            pixels = read_exr_image(self.path)
            if pixels.shape[-1] < 3:
                raise InputError("no R, G, B", self.path, "channels", "export a colour image")
        else:
            pixels, factor = read_bytes(self.path, 1 if self.mask else self.downscale)
            if self.downscale == 1 and self.mask is None and self.undistortion is None:
                return pixels
        mask = None if self.mask is None else self.mask.read()
        if mask is not None and self.mask is not None and mask.shape != (self.height, self.width):
            size = f"{mask.shape[1]} × {mask.shape[0]}"
            what = f"{size} pixels, but {self.path.name} has {self.width} × {self.height}"
            raise InputError(what, self.mask.path, "mask", "make both of one size")
        (width, height), block = self.size, self.downscale // factor
        bands, step = [], max(BAND // block, 1)
        for top in range(0, height, step):
            rows = slice(top * block, min(top + step, height) * block)
            band = pixels[rows, : width * block]
            if not linear:
                band = band.astype(np.float32) / np.float32(255)
            if mask is not None:
                shown = mask[rows, : width * block, None]
                covered = shown * band[..., 3:] if band.shape[-1] == 4 else shown
                # Colour of an EXR file is premultiplied by its own alpha already.
                colour = band[..., :3] * shown if linear else band[..., :3]
                band = np.concatenate([colour, covered], axis=-1)
            if band.shape[-1] == 4 and not linear:
                band[..., :3] *= band[..., 3:]
            bands.append(box_downscale(band, block))
        averaged = np.concatenate(bands)
        return averaged if self.undistortion is None else self.undistortion.resample(averaged)


class Pixels(NamedTuple):
    """The decoded image of a view: sRGB-encoded, or linear radiance of an EXR file."""

    image: np.ndarray  # (H, W, 3) float32, composited onto the background
    alpha: np.ndarray | None = None  # (H, W) float32

    @property
    def has_alpha(self) -> bool:
        return self.alpha is not None

    def without_alpha(self) -> Pixels:
        return Pixels(self.image)


def compose(decoded: np.ndarray, background: float) -> Pixels:
    """Composite a decoded image onto a background, a number from 0 to 1."""
    if decoded.dtype == np.uint8:
        decoded = decoded.astype(np.float32) / np.float32(255)
        if decoded.shape[-1] == 4:
            decoded[..., :3] *= decoded[..., 3:]
    colour = np.array(decoded[..., :3])
    if decoded.shape[-1] == 3:
        return Pixels(colour)
    alpha = np.array(decoded[..., 3])
    colour += (1 - alpha[..., None]) * np.float32(background)
    return Pixels(colour, alpha)


class ImageCache:
    """The most recently used decoded images of a data set, up to a number of bytes; threads may share it."""

    def __init__(self, budget: int | None = None) -> None:
        self.budget = CACHE_BYTES if budget is None else budget
        self.bytes = 0
        self._kept: OrderedDict[ImageFile, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def pixels(self, file: ImageFile) -> np.ndarray:
        """What `ImageFile.decode` returns, decoded unless it is kept."""
        with self._lock:
            if file in self._kept:
                self._kept.move_to_end(file)
                return self._kept[file]
        decoded = file.decode()
        with self._lock:
            if file not in self._kept:  # another thread may have decoded it meanwhile
                self._kept[file] = decoded
                self.bytes += decoded.nbytes
            while self.bytes > self.budget:
                self.bytes -= self._kept.popitem(last=False)[1].nbytes
        return decoded


@dataclass(frozen=True)
class ImageSource:
    """The image of a view that is not loaded."""

    file: ImageFile
    background: float
    cache: ImageCache
    has_alpha: bool  # if False, alpha of the file is ignored

    def without_alpha(self) -> ImageSource:
        return replace(self, has_alpha=False)

    def read(self) -> Pixels:
        pixels = compose(self.cache.pixels(self.file), self.background)
        return pixels if self.has_alpha else pixels.without_alpha()


@dataclass(frozen=True)
class ImageFolder:
    """The folder `images` of COLMAP's and LLFF's layouts, and the folder `masks` beside it."""

    path: Path
    masks: Path | None

    @classmethod
    def of(cls, root: Path, flat: bool = False) -> ImageFolder:
        """`images` below `root`, else the largest copies, such as `images_4`, else with `flat` `root`."""
        found = [root / name for name in (IMAGES, *COPIES) if (root / name).is_dir()]
        if not found and flat and any(map(_is_image, root.iterdir())):
            found = [root]
        if not found:
            raise InputError("no such folder", root, IMAGES, "put the images there")
        return cls(found[0], root / MASKS if (root / MASKS).is_dir() else None)

    def names(self) -> list[str]:
        """Sorted paths of the images, also in subfolders of a folder that contains nothing else."""
        pattern = "**/*" if self.path.name in (IMAGES, *COPIES) else "*"
        return sorted(str(path.relative_to(self.path)) for path in self.path.glob(pattern) if _is_image(path))

    def find(self, name: str) -> Path | None:
        """The file of an image, which may have another ending than the name; None without a file."""
        file = inside(self.path, name)
        if file is None:
            what = f"{abbreviated(name)} names no file in {self.path.name}"
            raise InputError(what, self.path.parent, remedy="move the image there")
        return file if is_file(file) else with_ending(file.with_suffix(""))

    def mask(self, name: str) -> Mask | None:
        return None if self.masks is None else mask_in(self.masks, name)


def mask_in(folder: Path, name: str) -> Mask:
    """The mask of an image in a folder of masks: `a.jpg.png`, `a.jpg` or `a.png` of `a.jpg`."""
    for candidate in (f"{name}.png", name, str(Path(name).with_suffix(".png"))):
        file = inside(folder, candidate)
        if file is not None and is_file(file):
            return Mask(file)
    raise InputError("missing", folder / f"{name}.png", "mask", "add it, or remove the folder of masks")


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in ENDINGS and not path.name.startswith(".")


def block_mean(
    pixels: np.ndarray,  # (H, W, C)
    covered: np.ndarray,  # (H, W, 1), 0 … 1
    downscale: int,
    straight: Undistortion | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over what is covered in each block, (h, w, C), 0 without coverage; covered fraction (h, w, 1)."""
    covered = covered.astype(np.float32)
    fraction, total = box_downscale(covered, downscale), box_downscale(pixels * covered, downscale)
    if straight is not None:  # linear interpolation, so that no weight is negative
        fraction, total = straight.resample(fraction, order=1), straight.resample(total, order=1)
    return np.where(fraction > 0, total / np.maximum(fraction, 1e-12), 0).astype(np.float32), fraction
