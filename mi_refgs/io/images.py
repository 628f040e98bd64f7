"""8-bit image files, the sRGB transfer function and PSNR in NumPy; linear formats are in `exr` and `hdr`."""

import contextlib
import math
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from mi_refgs.errors import InputError
from mi_refgs.io.exr import exr_header
from mi_refgs.io.files import check_size, is_file, replace_file, require_file

SRGB_LINEAR_LIMIT = 0.0031308  # linear value below which the sRGB curve is a straight line (IEC 61966-2-1)
SRGB_ENCODED_LIMIT = 0.04045  # the same point after encoding
SATURATED = 254.5 / 255.0  # from here up, 8-bit values are clipped: 255 means "at least this bright"
ALPHA_FLOOR = 1e-8  # alpha by which radiance is divided at least
ENDINGS = (".png", ".jpg", ".jpeg", ".webp")  # of 8-bit images, in the order in which they are tried
PSNR_MAX = 100.0  # dB, of identical images: JSON has no infinity


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
    """Convert premultiplied linear RGBA (H, W, 4) to that of PNG: sRGB(radiance / alpha), and alpha."""
    alpha = rgba[..., 3:]
    return np.concatenate([srgb_from_linear(rgba[..., :3] / np.maximum(alpha, ALPHA_FLOOR)), alpha], axis=-1)


def whole_blocks(length: int, factor: float) -> int:
    """Number of whole blocks of `factor` pixels along a side."""
    return int(length / factor + 1e-6)  # of length / n pixels: n, in spite of rounding


def box_downscale(image: np.ndarray, factor: float) -> np.ndarray:
    """Mean over the whole factor × factor blocks of an (H, W, C) image; what is left over is left out. Of a
    pixel that two blocks share, each counts its part."""
    if factor == 1:
        return image
    (height, width), channels = (whole_blocks(side, factor) for side in image.shape[:2]), image.shape[2]
    if (side := int(factor)) == factor:
        blocks = image[: height * side, : width * side].reshape(height, side, width, side, channels)
        return blocks.mean(axis=(1, 3), dtype=np.float64).astype(image.dtype)
    for count in (height, width):  # averages rows, then columns
        first, pixel = factor * np.arange(count)[:, None], np.arange(len(image))
        shared = np.minimum(pixel + 1, first + factor) - np.maximum(pixel, first)
        means = csr_array((np.maximum(shared, 0) / factor).astype(image.dtype))
        image = (means @ image.reshape(len(image), -1)).reshape(count, -1, channels).swapaxes(0, 1)
    return image


def blocks_within(mask: np.ndarray, factor: float) -> np.ndarray:
    """Which blocks of `box_downscale` lie wholly in a mask (H, W)."""
    return np.asarray(box_downscale(mask[..., None].astype(np.float32), factor)[..., 0] == 1)


def psnr_of(error: float) -> float:
    """PSNR in dB of the mean squared error of values up to 1; at most PSNR_MAX, NaN for NaN."""
    return PSNR_MAX if error <= 0 else min(-10 * float(np.log10(error)), PSNR_MAX)


def with_ending(stem: Path, endings: tuple[str, ...] = ENDINGS) -> Path | None:
    """The file whose name is `stem` and an ending, in any case; of several, the first of `endings`."""
    for ending in endings:
        for suffix in (ending, ending.upper()):
            if is_file(file := stem.with_name(stem.name + suffix)):
                return file
    try:
        others = sorted(path for path in stem.parent.iterdir() if path.name.startswith(f"{stem.name}."))
    except (OSError, ValueError):  # an impossible name
        return None
    by_ending = {path.name[len(stem.name) :].lower(): path for path in others if is_file(path)}
    return next((by_ending[ending] for ending in endings if ending in by_ending), None)


def image_header(path: Path) -> tuple[int, int, bool]:
    """Width and height of a PNG, JPEG or EXR file, and whether it has alpha; raises as its reader does."""
    if path.suffix.lower() == ".exr":
        return exr_header(path)
    with open_image(path) as image:
        return *image.size, bool(image.has_transparency_data)


def read_png(path: str | Path) -> np.ndarray:
    """8-bit image file as float32 (H, W, 3 or 4) in [0, 1], sRGB encoded; raises InputError for others."""
    return read_bytes(path)[0].astype(np.float32) / np.float32(255)


def read_bytes(path: str | Path, shrink: int = 1) -> tuple[np.ndarray, int]:
    """8-bit PNG or JPEG as uint8 (H, W, 3 or 4), and the factor by which both sides are smaller: it divides
    `shrink`, and is 1 but for JPEG files. Raises InputError as `read_png` does."""
    path = Path(path)
    with open_image(path) as image:
        if image.mode.startswith(("I", "F")):
            raise InputError("more than 8 bits per channel", path, "pixels", "save it as 8-bit PNG or EXR")
        # The decoder can return 8 × 8, 4 × 4, 2 × 2 or 1 pixels for each block of 8 × 8.
        factor = math.gcd(shrink, 8) if image.format == "JPEG" else 1
        if factor > 1:
            image.draft(None, tuple(max(side // factor, 1) for side in image.size))
        return np.asarray(image.convert("RGBA" if image.has_transparency_data else "RGB")), factor


def read_grey(path: str | Path) -> tuple[np.ndarray, int]:
    """Brightness (H, W) of a PNG or JPEG, of colours that of the brightest channel as a share of the largest,
    or alpha if it has transparent pixels, or whether a pixel is not black if a palette has colours, as
    segmentation tools write labels; and white, the least of 1, 255, 65535 that no label exceeds."""
    path = Path(path)
    with open_image(path) as image:
        if image.mode.startswith("I"):
            grey = np.asarray(image)
        else:
            grey, alpha = np.moveaxis(np.asarray(image.convert("LA")), -1, 0)
            if not (alpha == 255).all():
                grey = alpha
            elif ((colours := np.asarray(image.convert("RGB"))) != colours[..., :1]).any():
                grey = colours.max(axis=-1) / colours.max()
                grey = grey > 0 if image.mode == "P" else grey
    return grey, next((white for white in (1, 255) if grey.max() <= white), 65535)


def read_mask(path: str | Path) -> np.ndarray:
    """Alpha (H, W) float32, 0 … 1, from an image as `read_grey` reads it; raises InputError as it does."""
    grey, white = read_grey(path)
    return grey.astype(np.float32) / np.float32(white)


def read_tiff(path: str | Path) -> np.ndarray:
    """Numbers (H, W) float32 of a TIFF file of one channel: floats, or 16 bits as 0 … 1."""
    path = Path(path)
    with open_image(path, "TIFF") as image:
        if image.mode != "F" and not image.mode.startswith("I;16"):
            raise InputError("not one channel of floats or 16 bits", path, "pixels", "export it again")
        scale = 1 if image.mode == "F" else 65535
        return np.nan_to_num(np.asarray(image, dtype=np.float32) / np.float32(scale))


@contextlib.contextmanager
def open_image(path: Path, *formats: str) -> Iterator[Any]:
    """Open a PNG or JPEG file, or one of `formats`, and check its size."""
    from PIL import Image

    require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `check_size` is stricter
            image = Image.open(path, formats=formats or ("PNG", "JPEG", "WEBP"))
        with image:
            check_size(path, *image.size, len(image.getbands()))
            yield image
    except InputError:
        raise
    except Exception as error:  # Pillow raises half a dozen types for broken files
        with path.open("rb") as file:
            other = file.read(8)[4:] == b"ftyp"
        what = "a HEIC, AVIF or video file of another name" if other else f"not a readable image ({error})"
        raise InputError(what, path, "pixels", "export it again, as JPEG or PNG") from error


def exif_tags(image: Any) -> tuple[dict[int, Any], dict[int, Any]]:
    """EXIF data of a PIL image: tags of the image and of the camera settings, without broken ones."""
    tags: dict[int, Any] = {}
    settings: dict[int, Any] = {}
    with contextlib.suppress(Exception):  # Pillow raises many types for broken data
        exif = image.getexif()
        for tag in exif:
            with contextlib.suppress(Exception):
                tags[tag] = exif[tag]
        settings.update(exif.get_ifd(0x8769))  # of the camera (EXIF 2.3)
    return tags, settings


def positive(value: object) -> float | None:
    """A positive number in EXIF data, which may be a fraction with denominator 0, or anything; else None."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < np.inf else None


def to_8_bits(image: np.ndarray) -> np.ndarray:
    """Quantise values in [0, 1] (clipped; NaN is 0) to uint8."""
    return np.asarray(np.round(np.clip(np.nan_to_num(image), 0, 1) * 255), dtype=np.uint8)


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write an (H, W) or (H, W, 3 or 4) image, sRGB encoded, as 8-bit PNG; raises as `replace_file`."""
    from PIL import Image

    replace_file(path, lambda temporary: Image.fromarray(to_8_bits(image)).save(temporary, format="PNG"))
