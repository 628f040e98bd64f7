"""Images of a data set: where their files are, how a file becomes an image of a view, and a bounded cache. A
file is decoded, its colour multiplied by alpha (its own, or that of a mask), averaged over blocks of pixels,
undistorted and composited onto the background. An orientation in EXIF data is ignored, as in COLMAP."""

import math
import os
import re
import threading
import unicodedata
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, product
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_refgs.data.lens import Undistortion
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io import images as io
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.files import is_file

CACHE_BYTES = 2**30  # of decoded images that a data set keeps: 28 of 12 Mpx, a thousand of 600 × 600
OVERSHOOT = 0.25  # of alpha beyond 0 … 1 in an EXR file: filters with negative lobes have an eighth
BAND = 256  # rows of a file that are converted to floating point at a time, for less memory
MASKS = "masks"
FOLDERS = ("images", "images_2", "images_4", "images_8", "input", "rgb", "image")
"""Folders of images, in the order in which they are tried; images_2 … contain smaller copies."""
MASK = re.compile(r"(?i)(^|[-_. ])(masks?|alphas?|mattes?|silhouettes?)($|[-_. ])")  # in names of folders
MARKS = ("", ".mask", "_mask", "-mask", "_alpha")  # after the name of an image in that of its mask


@dataclass(frozen=True)
class Mask:
    """An image that says where the object is, of the size of another image."""

    path: Path
    below: int | None = None  # if given, alpha is 1 where the file's number (a 16-bit depth) is less, else 0

    def read(self) -> np.ndarray:
        """Alpha (H, W) float32."""
        if self.below is None:
            return io.read_mask(self.path)
        return (io.read_grey(self.path)[0] < self.below).astype(np.float32)


@dataclass(frozen=True)
class ImageFile:
    """An image file, and how it becomes the image of a view."""

    path: Path
    width: int  # pixels, of the file
    height: int
    downscale: float = 1
    mask: Mask | None = None
    undistortion: Undistortion | None = None  # of the averaged image

    @classmethod
    def of(cls, path: Path, downscale: float, mask: Mask | None = None) -> "ImageFile":
        """The image in a file, of which only the header is read."""
        width, height, _ = io.image_header(path)
        if min(width, height) < downscale:
            what = f"{width} × {height} pixels are less than a block of {downscale:g}²"
            raise InputError(what, path, "downscale", "give a smaller number")
        return cls(path, width, height, downscale, mask)

    @property
    def size(self) -> tuple[int, int]:
        """Of the view's image."""
        return io.whole_blocks(self.width, self.downscale), io.whole_blocks(self.height, self.downscale)

    @property
    def is_linear_radiance(self) -> bool:
        return self.path.suffix.lower() == ".exr"

    def has_alpha(self) -> bool:
        """Whether there is alpha, by the file's header."""
        return self.mask is not None or io.image_header(self.path)[2]

    def decode(self) -> np.ndarray:
        """(H, W, 3 or 4): uint8 as in the file, else float32, averaged and premultiplied."""
        from PIL import Image

        linear, factor = self.is_linear_radiance, 1
        if linear:
            pixels = read_exr_image(self.path)
            if pixels.shape[-1] < 3:
                raise InputError("no R, G, B", self.path, "channels", "export a colour image")
            if np.abs(pixels[..., 3:] - 0.5).max(initial=0) > 0.5 + OVERSHOOT:
                raise InputError("beyond 0 … 1", self.path, "A", "export alpha from 0 to 1")
        else:
            pixels, factor = io.read_bytes(self.path, 1 if self.mask else int(self.downscale))
            if self.downscale == 1 and self.mask is None and self.undistortion is None:
                return pixels
        mask = None if self.mask is None else self.mask.read()
        if mask is not None and self.mask is not None and mask.shape != (self.height, self.width):
            if not is_copy(mask.shape[::-1], (self.width, self.height)):
                size = f"{mask.shape[1]} × {mask.shape[0]}"
                what = f"{size} pixels, but {self.path.name} has {self.width} × {self.height}"
                raise InputError(what, self.mask.path, "mask", "make both of one size")
            whole, linearly = (self.width, self.height), Image.Resampling.BILINEAR  # averages, if smaller
            mask = np.asarray(Image.fromarray(mask).resize(whole, linearly))
        (width, height), block = self.size, self.downscale / factor
        bands, step = [], max(int(BAND / block), 1) if block == int(block) else height
        right = math.ceil(width * block)
        for top in range(0, height, step):
            rows = slice(int(top * block), math.ceil(min(top + step, height) * block))
            band = pixels[rows, :right]
            if not linear:
                band = band.astype(np.float32) / np.float32(255)
            if mask is not None:
                shown = mask[rows, :right, None]
                covered = shown * band[..., 3:] if band.shape[-1] == 4 else shown
                # Colour of an EXR file is premultiplied by its own alpha already.
                colour = band[..., :3] * shown if linear else band[..., :3]
                band = np.concatenate([colour, covered], axis=-1)
            if band.shape[-1] == 4 and not linear:
                band[..., :3] *= band[..., 3:]
            bands.append(io.box_downscale(band, block))
        averaged = np.concatenate(bands)
        return averaged if self.undistortion is None else self.undistortion.resample(averaged)


class Pixels(NamedTuple):
    """The decoded image of a view: sRGB-encoded, or linear radiance of an EXR file."""

    image: np.ndarray  # (H, W, 3) float32, composited onto the background
    alpha: np.ndarray | None = None  # (H, W) float32

    @property
    def has_alpha(self) -> bool:
        return self.alpha is not None

    def without_alpha(self) -> "Pixels":
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

    def without_alpha(self) -> "ImageSource":
        return replace(self, has_alpha=False)

    def read(self) -> Pixels:
        pixels = compose(self.cache.pixels(self.file), self.background)
        return pixels if self.has_alpha else pixels.without_alpha()


def is_copy(size: tuple[float, ...], of: tuple[float, ...]) -> bool:
    """Whether two sizes have one aspect ratio, rounded by up to a pixel per side of the smaller one."""
    return abs(size[0] * of[1] - size[1] * of[0]) < max(sum(size), sum(of))


def image_folder(root: Path, model: Path) -> tuple[Path, Path]:
    """The first of FOLDERS in `model`, or in its nearest parent in `root` that has one, and that parent; else
    twice the nearest that contains images. Raises InputError without any."""
    parents = [path for path in (model, *model.parents) if path.is_relative_to(root)]
    folders = ((path / name, path) for path in parents for name in FOLDERS if (path / name).is_dir())
    flat = ((path, path) for path in parents if image_files(path, deep=False))
    if found := next(chain(folders, flat), None):
        return found
    raise InputError("no such folder", root, FOLDERS[0], "put the images there, or give its parent")


def image_files(folder: Path, deep: bool) -> list[Path]:
    """The images of a folder by name, `deep` with those of subfolders; neither hidden ones nor masks."""
    files = folder.glob("**/*" if deep else "*")
    seen = (p for p in files if not any(part.startswith(".") for part in p.relative_to(folder).parts))
    paths = sorted(p for p in seen if p.suffix.lower() in io.ENDINGS)
    masks = {f"{path.with_suffix('')}{mark}" for path in paths for mark in MARKS[1:]}
    return [path for path in paths if str(path.with_suffix("")) not in masks]


def find_image(folders: Sequence[Path], name: str, tell: Callable[[str, str, object], None]) -> Path | None:
    """The file in one of `folders` that another program calls `name`, whatever its ending; of an absolute
    name, or one in FOLDERS, that of its last parts, of which `tell`, such as `ReadOptions.say`, is told."""
    path = os.path.normpath(name.replace("\\", "/"))
    written = dict.fromkeys((path, *(unicodedata.normalize(form, path) for form in ("NFC", "NFD"))))
    parts = path.split("/")
    away = parts[0] in ("", os.pardir) or parts[0].endswith(":")
    starts = range(len(parts)) if away else range(1 + (parts[0] in FOLDERS))
    for text, start, folder in product(written, starts, folders):
        parts = text.split("/")
        if parts[start:] and parts[start] not in ("", os.curdir, os.pardir):
            file = folder.joinpath(*parts[start:])
            found = file if is_file(file) else io.with_ending(file)
            if found is None and not file.suffix[1:].isdigit():  # a number is part of the name
                found = io.with_ending(file.with_suffix(""), (file.suffix.lower(), *io.ENDINGS, ".exr"))
            if found is not None:
                if start:
                    tell("the path leads elsewhere, and its last parts are read", name, abbreviated(name))
                return found
    return None


def mask_of(image: Path, root: Path, marks: Sequence[str] = MARKS[1:]) -> Mask | None:
    """The mask of an image of `root`: beside it with one of `marks`, such as a_mask.png of a.jpg, or
    in a folder such as masks, or train_mask of its folder train. Raises InputError if it is not there."""
    if found := _mask_file(image.parent, image.name, marks):
        return Mask(found)
    name = image.relative_to(root)
    own = name.parts[0] if len(name.parts) > 1 else ""
    others = (path for path in sorted(root.iterdir()) if path.name != own)
    folders = [path for path in others if MASK.search(path.name) and path.is_dir()]
    images = {path: MASK.sub("", path.name) for path in folders}  # the folder whose masks these are, or ""
    folders = [path for path in folders if images[path] in ("", own) or not (root / images[path]).is_dir()]
    if not folders:
        return None
    best = min(folders, key=lambda path: (images[path] != own, images[path] != "", path.name != MASKS))
    return Mask(mask_in(best, str(name.relative_to(own) if own in (*FOLDERS, images[best]) else name)))


def mask_in(folder: Path, name: str, beside: bool = False) -> Path:
    """The mask of an image in a folder of masks: of `a.jpg` `a.jpg.png`, `a.png`, `a_mask.png` and so on;
    `beside` the images it has a mark, such as `_mask`."""
    if found := _mask_file(folder, name, MARKS[beside:]):
        return found
    wanted = folder / Path(name).with_suffix(".png")
    raise InputError("missing", wanted, "mask", "add it, or remove the folder of masks")


def _mask_file(folder: Path, name: str, marks: Sequence[str]) -> Path | None:
    endings = (*io.ENDINGS, *(ending.upper() for ending in io.ENDINGS))
    stems = (name, str(Path(name).with_suffix("")))
    files = (folder / f"{stem}{mark}{ending}" for stem, mark, ending in product(stems, marks, endings))
    return next((file for file in files if is_file(file)), None)


def block_mean(
    pixels: np.ndarray,  # (H, W, C)
    covered: np.ndarray,  # (H, W, 1), 0 … 1
    downscale: float,
    straight: Undistortion | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over what is covered in each block, (h, w, C), 0 without coverage; covered fraction (h, w, 1)."""
    covered = covered.astype(np.float32)
    fraction, total = io.box_downscale(covered, downscale), io.box_downscale(pixels * covered, downscale)
    if straight is not None:  # linear interpolation, so that no weight is negative
        fraction, total = straight.resample(fraction, order=1), straight.resample(total, order=1)
    return np.where(fraction > 0, total / np.maximum(fraction, 1e-12), 0).astype(np.float32), fraction
