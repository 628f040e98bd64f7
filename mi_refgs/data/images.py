"""Images of a data set: where their files are, how a file becomes an image of a view, and a bounded cache.

A file is decoded, its colour multiplied by alpha (its own, or that of a mask), averaged over blocks of
`downscale` × `downscale` pixels, undistorted and composited onto the background. Rows and columns are those
of the file: an orientation in its EXIF data is ignored, as in COLMAP.
"""

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

CACHE_BYTES = 2**30
"""Largest size of the decoded images that a data set keeps: 28 of 12 Mpx, or a thousand of 600 × 600. 300
photographs of 12 Mpx would need 11 GB."""
BAND = 256
"""Rows of a file that are converted to floating point at a time; a large image would need half a gigabyte."""
IMAGES, MASKS = "images", "masks"  # names of folders
COPIES = (8, 4, 2)  # factors of the smaller copies of images, in `images_8` and so on


@dataclass(frozen=True)
class Mask:
    """An image that says where the object is, of the size of another image."""

    path: Path
    below: int | None = None  # if given, alpha is 1 where the file's number (a 16-bit depth) is less, else 0

    def read(self) -> np.ndarray:
        """Alpha (H, W) float32; raises InputError for a file that cannot be read."""
        grey = None if self.below is None else read_grey(self.path)[0] < self.below
        return read_mask(self.path) if grey is None else grey.astype(np.float32)


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
        """The image in a file, of which only the header is read.

        Raises InputError for a file that cannot be used or is smaller than one block of pixels.
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
        """Width and height of the view's image."""
        return self.width // self.downscale, self.height // self.downscale

    @property
    def is_linear_radiance(self) -> bool:
        return self.path.suffix.lower() == ".exr"

    @property
    def _is_unchanged(self) -> bool:
        """Whether the view shows the 8-bit numbers of the file."""
        changed = self.downscale > 1 or self.mask is not None or self.undistortion is not None
        return not changed and not self.is_linear_radiance

    @property
    def decoded_bytes(self) -> int:
        """Upper bound of the size of what `decode` returns."""
        width, height = self.size
        return 4 * width * height * (1 if self._is_unchanged else 4)

    def has_alpha(self) -> bool:
        """Whether there is alpha, by the file's header."""
        header = exr_has_alpha if self.is_linear_radiance else has_alpha
        return self.mask is not None or header(self.path)

    def decode(self) -> np.ndarray:
        """Decode the file to what `compose` takes, (H, W, 3 or 4): uint8 as in the file if it is unchanged,
        else float32, premultiplied.

        Raises InputError for a file that cannot be read and for a mask of another size.
        """
        if self._is_unchanged:
            return read_bytes(self.path)[0]
        averaged = self._averaged()
        return averaged if self.undistortion is None else self.undistortion.resample(averaged)

    def _averaged(self) -> np.ndarray:
        """Premultiplied colour, and alpha if there is any, averaged over blocks: (H, W, 3 or 4) float32."""
        linear = self.is_linear_radiance
        if linear:
            pixels, factor = read_exr_image(self.path), 1
            if pixels.shape[-1] < 3:
                raise InputError(f"{self.path}: channels: no R, G, B; export a colour image")
        else:
            pixels, factor = read_bytes(self.path, 1 if self.mask else self.downscale)
        mask = None if self.mask is None else self.mask.read()
        if mask is not None and self.mask is not None and mask.shape != (self.height, self.width):
            raise InputError(
                f"{self.mask.path}: mask: {mask.shape[1]} × {mask.shape[0]} pixels, but {self.path.name} "
                f"has {self.width} × {self.height}; make both of one size"
            )
        width, height = self.size
        block = self.downscale // factor
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
        return np.concatenate(bands)


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
    """Composite what `ImageFile.decode` returned onto a background, a number from 0 to 1."""
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
    """Decoded images of one data set, the most recently used ones, up to a number of bytes.

    Threads may share it: an image that two of them need is decoded twice at worst.
    """

    def __init__(self, budget: int | None = None) -> None:
        self.budget = CACHE_BYTES if budget is None else budget
        self.bytes = 0
        self._kept: OrderedDict[ImageFile, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def pixels(self, file: ImageFile) -> np.ndarray:
        """What `ImageFile.decode` returns, decoded unless it is kept; raises InputError as that does."""
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

    def has_room_for(self, file: ImageFile) -> bool:
        """Whether the image can be kept without dropping others."""
        return self.bytes + file.decoded_bytes <= self.budget


@dataclass(frozen=True)
class ImageSource:
    """The image of a view that is not loaded."""

    file: ImageFile
    background: float
    cache: ImageCache
    has_alpha: bool  # if False, alpha of the file is ignored

    @classmethod
    def of(cls, file: ImageFile, background: float, cache: ImageCache, decode: bool = True) -> ImageSource:
        """`decode`: decode the file now if the cache has room, so that a broken file is refused early.

        Raises InputError as `ImageFile.decode` does.
        """
        decoded = cache.pixels(file) if decode and cache.has_room_for(file) else None
        has_alpha = file.has_alpha() if decoded is None else decoded.shape[-1] == 4
        return cls(file, background, cache, has_alpha)

    def without_alpha(self) -> ImageSource:
        return replace(self, has_alpha=False)

    def read(self) -> Pixels:
        """Decode the image, unless it is in the cache; raises InputError as `ImageFile.decode` does."""
        pixels = compose(self.cache.pixels(self.file), self.background)
        return pixels if self.has_alpha else pixels.without_alpha()


@dataclass(frozen=True)
class ImageFolders:
    """Folders of images as COLMAP and LLFF have them: `images`, smaller copies in `images_2` …, and `masks`.

    The largest images have factor 1: those of `images`, or of copies where it is missing.
    """

    root: Path
    folders: dict[int, Path]  # by their factor
    masks: Path | None

    @classmethod
    def of(cls, root: Path, flat: bool = False) -> ImageFolders:
        """The folders below `root`; `flat`: `root` itself may contain the images if there are none.

        Raises InputError if there is no folder of images.
        """
        names = {**{k: f"{IMAGES}_{k}" for k in COPIES}, 1: IMAGES}
        found = {k: root / name for k, name in names.items() if (root / name).is_dir()}
        if not found and flat and any(map(_is_image, root.iterdir())):
            found[1] = root
        if not found:
            raise InputError(f"{root}: images: no such folder; put the images there")
        folders = {k // min(found): folder for k, folder in found.items()}
        return cls(root, folders, root / MASKS if (root / MASKS).is_dir() else None)

    def names(self) -> list[str]:
        """Sorted paths of the largest images relative to their folder, those in subfolders included."""
        folder = self.folders[1]
        pattern = "*" if folder == self.root else "**/*"
        return sorted(str(path.relative_to(folder)) for path in folder.glob(pattern) if _is_image(path))

    def find(self, name: str, downscale: int) -> tuple[Path, int] | None:
        """The file of an image, and the factor by which it still has to be averaged; None without a file.

        The smallest copy whose factor divides `downscale` is used; with masks, the largest. A copy may
        have another ending than the name. Raises InputError for a name that leads out of the folder.
        """
        for factor, folder in sorted(self.folders.items(), reverse=True):
            if downscale % factor or (self.masks is not None and factor > 1):
                continue
            file = inside(folder, name)
            if file is None:
                raise InputError(
                    f"{self.root}: {abbreviated(name)} names no file in {folder.name}; move the image there"
                )
            if found := file if is_file(file) else with_ending(file.with_suffix("")):
                return found, downscale // factor
        return None

    def mask(self, name: str) -> Mask | None:
        """The mask of an image; None without a folder of masks. Raises InputError as `mask_in`."""
        return None if self.masks is None else mask_in(self.masks, name)


def mask_in(folder: Path, name: str) -> Mask:
    """The mask of an image in a folder of masks: `a.jpg.png`, `a.jpg` or `a.png` of `a.jpg`.

    Raises InputError if there is none although others have one.
    """
    for candidate in (f"{name}.png", name, str(Path(name).with_suffix(".png"))):
        file = inside(folder, candidate)
        if file is not None and is_file(file):
            return Mask(file)
    raise InputError(f"{folder / (name + '.png')}: mask: missing; add it, or remove the folder of masks")


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in ENDINGS and not path.name.startswith(".")
