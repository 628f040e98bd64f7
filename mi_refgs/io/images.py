"""8-bit image files, sRGB's transfer function and PSNR in NumPy; `exr` and `hdr` hold the linear formats."""

from __future__ import annotations

import contextlib
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.exr import exr_size
from mi_refgs.io.files import check_size, is_file, replace_file, require_file

SRGB_LINEAR_LIMIT = 0.0031308
"""Linear value below which the sRGB curve is a straight line (IEC 61966-2-1)."""
SRGB_ENCODED_LIMIT = 0.04045
"""The same point after encoding."""
ALPHA_FLOOR = 1e-8
"""Alpha that radiance is divided by at least: what covers so little has no colour."""

ENDINGS = (".png", ".jpg", ".jpeg")
"""Endings of the names of 8-bit image files, in small letters, in the order in which they are tried."""
EXIF_IFD = 0x8769
"""Tag of EXIF 2.3: the table of the camera's settings."""
PSNR_MAX = 100.0
"""What identical images read, dB: JSON has no infinity, and float32 images cannot differ by less."""
JPEG_SHRINK = 8
"""A JPEG file's blocks have 8 × 8 pixels: its decoder can give 8, 4, 2 or 1 pixels a side for each."""


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """sRGB encoding of linear values (IEC 61966-2-1); negatives stay on the line, nothing is clipped."""
    linear = np.asarray(linear)
    curve = 1.055 * np.maximum(linear, SRGB_LINEAR_LIMIT) ** (1 / 2.4) - 0.055
    return np.where(linear <= SRGB_LINEAR_LIMIT, 12.92 * linear, curve).astype(linear.dtype)


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Inverse of `srgb_from_linear`."""
    encoded = np.asarray(encoded)
    curve = ((np.maximum(encoded, SRGB_ENCODED_LIMIT) + 0.055) / 1.055) ** 2.4
    return np.where(encoded <= SRGB_ENCODED_LIMIT, encoded / 12.92, curve).astype(encoded.dtype)


def straight_srgb(rgba: np.ndarray) -> np.ndarray:
    """What an RGBA PNG holds of premultiplied linear RGBA (H, W, 4): sRGB(radiance / alpha), and alpha."""
    alpha = rgba[..., 3:]
    colour = srgb_from_linear(rgba[..., :3] / np.maximum(alpha, ALPHA_FLOOR))
    return np.concatenate([colour, alpha], axis=-1)


def box_downscale(image: np.ndarray, factor: int) -> np.ndarray:
    """Mean over factor × factor blocks of an (H, W, C) image.

    Rows below and columns right of the last whole block are left out: coordinates only divide by `factor`.
    """
    if factor == 1:
        return image
    height, width, channels = image.shape[0] // factor, image.shape[1] // factor, image.shape[2]
    whole = image[: height * factor, : width * factor]
    blocks = whole.reshape(height, factor, width, factor, channels)
    return blocks.mean(axis=(1, 3), dtype=np.float64).astype(image.dtype)


def psnr_of(error: float) -> float:
    """PSNR in dB of a mean squared error of values up to 1; at most PSNR_MAX, NaN of NaN."""
    return PSNR_MAX if error <= 0 else min(-10 * float(np.log10(error)), PSNR_MAX)


def with_ending(stem: Path, endings: tuple[str, ...] = ENDINGS) -> Path | None:
    """The file whose name is that of `stem` and an ending, in letters of any case; None without one.

    Of several the first in the order of `endings`.
    """
    for ending in endings:
        for suffix in (ending, ending.upper()):
            if is_file(file := stem.with_name(stem.name + suffix)):
                return file
    try:
        others = sorted(path for path in stem.parent.iterdir() if path.name.startswith(f"{stem.name}."))
    except OSError:
        return None
    by_ending = {path.name[len(stem.name) :].lower(): path for path in others if is_file(path)}
    return next((by_ending[ending] for ending in endings if ending in by_ending), None)


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height, pixels, of a PNG, JPEG or EXR file, from its header.

    Raises InputError as the file's reader does.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return exr_size(path)
    with open_picture(path) as picture:
        width, height = picture.size
        return int(width), int(height)


def read_png(path: str | Path) -> np.ndarray:
    """8-bit image file (PNG, JPEG) as float32 (H, W, 3 or 4) in [0, 1], still sRGB encoded, alpha straight.

    Raises InputError if the file is missing, unreadable or has more than 8 bits per channel.
    """
    return read_bytes(path)[0].astype(np.float32) / np.float32(255)


def read_bytes(path: str | Path, shrink: int = 1) -> tuple[np.ndarray, int]:
    """8-bit image file (PNG, JPEG) as uint8 (H, W, 3 or 4), and the factor by which both sides are smaller.

    The factor is the largest divisor of `shrink` by which the decoder shrinks for less than a whole decoding
    costs: of a JPEG file 2, 4 or 8, of others 1. A last block of fewer pixels counts as one, too. Raises
    InputError as `read_png` does.
    """
    path = Path(path)
    with open_picture(path) as picture:
        if picture.mode.startswith(("I", "F")):
            raise InputError(f"{path}: pixels: more than 8 bits per channel; save it as 8-bit PNG or EXR")
        factor = math.gcd(shrink, JPEG_SHRINK) if picture.format == "JPEG" else 1
        if factor > 1:
            picture.draft(None, tuple(max(side // factor, 1) for side in picture.size))
        return np.asarray(picture.convert("RGBA" if _transparent(picture) else "RGB")), factor


def read_grey(path: str | Path) -> tuple[np.ndarray, int]:
    """Brightness (H, W) of a PNG or JPEG of 8 or 16 bits, and the number that means white.

    Of a picture with transparent pixels, which is cut out, it is alpha. White is the smallest of 1, 255 and
    65535 that no number of the file exceeds: files of 8 and 16 bits may hold labels, and files of 16 bits the
    numbers of 8. Raises InputError if the file is missing or unreadable.
    """
    path = Path(path)
    with open_picture(path) as picture:
        if picture.mode.startswith("I"):
            grey = np.asarray(picture)
        else:
            grey, alpha = np.moveaxis(np.asarray(picture.convert("LA")), -1, 0)
            if not (alpha == 255).all():
                grey = alpha
    return grey, next((white for white in (1, 255) if grey.max() <= white), 65535)


def read_mask(path: str | Path) -> np.ndarray:
    """Alpha (H, W) float32, 0 … 1, from a picture as `read_grey` takes it; raises InputError as it does."""
    grey, white = read_grey(path)
    return grey.astype(np.float32) / np.float32(white)


def read_tiff(path: str | Path) -> np.ndarray:
    """The numbers (H, W) float32 of a TIFF file with one channel, floating-point or of 16 bits as 0 … 1.

    Raises InputError if the file is missing, unreadable or holds something else.
    """
    path = Path(path)
    with open_picture(path, "TIFF") as picture:
        if picture.mode != "F" and not picture.mode.startswith("I;16"):
            raise InputError(f"{path}: pixels: not one channel of floats or 16 bits; export it again")
        scale = 1 if picture.mode == "F" else 65535
        return np.nan_to_num(np.asarray(picture, dtype=np.float32) / np.float32(scale))


def has_alpha(path: str | Path) -> bool:
    """Whether a PNG or JPEG file has alpha, from its header; raises InputError as `read_png` does."""
    with open_picture(Path(path)) as picture:
        return _transparent(picture)


def is_opaque(path: Path) -> bool:
    """Whether no pixel of a PNG or JPEG file is transparent; raises InputError as `read_png` does."""
    with open_picture(path) as picture:
        whole = picture if picture.mode in ("RGBA", "LA") else picture.convert("RGBA")
        return bool(whole.getchannel("A").getextrema()[0] == 255)


def _transparent(picture: Any) -> bool:
    return picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info


@contextlib.contextmanager
def open_picture(path: Path, *formats: str) -> Iterator[Any]:
    """A PNG or JPEG file, or one of `formats`, whose header is read and whose size is believable."""
    from PIL import Image

    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `check_size` is stricter
            picture = Image.open(path, formats=formats or ("PNG", "JPEG"))
        with picture:
            check_size(path, *picture.size, len(picture.getbands()))
            yield picture
    except InputError:
        raise
    except Exception as error:  # Pillow raises half a dozen types for broken files
        raise InputError(f"{path}: pixels: not a readable image ({error}); export it again") from error


def exif_tags(picture: Any) -> tuple[dict[int, Any], dict[int, Any]]:
    """EXIF data of a PIL image: the tags of the picture and of the camera's settings, less what is broken."""
    tags: dict[int, Any] = {}
    settings: dict[int, Any] = {}
    with contextlib.suppress(Exception):  # Pillow raises many types for broken data, which no picture needs
        exif = picture.getexif()
        for tag in exif:
            with contextlib.suppress(Exception):
                tags[tag] = exif[tag]
        settings.update(exif.get_ifd(EXIF_IFD))
    return tags, settings


def to_8_bits(image: np.ndarray) -> np.ndarray:
    """Values in [0, 1] (clipped; NaN is 0) as uint8 of the same shape."""
    return np.asarray(np.round(np.clip(np.nan_to_num(image), 0, 1) * 255), dtype=np.uint8)


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write an (H, W, 3 or 4) image, sRGB-encoded values in [0, 1] (clipped), as 8-bit PNG, atomically.

    Raises InputError if the path cannot be written.
    """
    from PIL import Image

    pixels = to_8_bits(image)
    replace_file(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG"))
