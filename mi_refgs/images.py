"""Image files and the sRGB transfer function in NumPy: 8-bit PNG and float EXR, written whole or not.

Mitsuba's own EXR files are left to it only where it loads or saves a scene (`mitsuba_exr` says why).
"""

from __future__ import annotations

import contextlib
import re
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.files import is_file, replace_file

SRGB_LINEAR_LIMIT = 0.0031308
"""Linear value below which the sRGB curve is a straight line (IEC 61966-2-1)."""
SRGB_ENCODED_LIMIT = 0.04045
"""The same point after encoding."""
EXR_MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of every EXR file."""
EXR_OTHER_FLAGS = 0x1800
"""Bits of the version for deep data and for several parts."""
EXR_BYTES = (4, 2, 4)
"""Bytes of a sample by pixel type: UINT, HALF, FLOAT."""
EXR_CHANNEL = 17
"""Bytes of an entry of the list of channels after its name, the name's zero included."""
MAX_EXR_HEADER = 2**20
"""Bytes; headers with a preview picture have tens of kilobytes."""
ANY_FILE = 2**24
"""Bytes of pixels that any file may promise."""
MAX_EXPANSION = 1100
"""Bytes of pixels that a byte of a larger file may promise: DEFLATE cannot expand by more than 1,032."""
MAX_HDR_HEADER = 2**16
"""Bytes in which the size of a Radiance picture must stand."""
SRGB_CHROMATICITIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""x, y of red, green, blue and white (ITU-R BT.709), which an EXR file without the attribute has."""
CHROMATICITY_TOLERANCE = 1e-3
"""Half the last digit that standards give, and far below the difference between any two of them."""
MITSUBA_EXR_THREADS = 2
"""Mitsuba 3.9 reads and writes EXR files on a worker thread; with one thread in all it waits for ever."""


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


def image_size(path: str | Path) -> tuple[int, int]:
    """Width and height, pixels, of a PNG, JPEG or EXR file, from its header.

    Raises InputError as the file's reader does.
    """
    path = Path(path)
    if path.suffix.lower() == ".exr":
        return _exr_size(path)
    with _open_picture(path) as picture:
        width, height = picture.size
        return int(width), int(height)


def read_png(path: str | Path) -> np.ndarray:
    """8-bit image file (PNG, JPEG) as float32 (H, W, 3 or 4) in [0, 1], still sRGB encoded, alpha straight.

    Raises InputError if the file is missing, unreadable or has more than 8 bits per channel.
    """
    path = Path(path)
    with _open_picture(path) as picture:
        if picture.mode.startswith(("I", "F")):
            raise InputError(f"{path}: pixels: more than 8 bits per channel; save it as 8-bit PNG or EXR")
        transparent = picture.mode in ("RGBA", "LA", "PA") or "transparency" in picture.info
        pixels = np.asarray(picture.convert("RGBA" if transparent else "RGB"))
    return pixels.astype(np.float32) / np.float32(255)


@contextlib.contextmanager
def _open_picture(path: Path) -> Iterator[Any]:
    """A PNG or JPEG file whose header is read and whose size is believable."""
    from PIL import Image

    _require_file(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # `_check_size` asks for more
            picture = Image.open(path, formats=("PNG", "JPEG"))
        with picture:
            _check_size(path, *picture.size, len(picture.getbands()))
            yield picture
    except InputError:
        raise
    except Exception as error:  # Pillow raises half a dozen types for broken files
        raise InputError(f"{path}: pixels: not a readable image ({error}); export it again") from error


def _check_size(path: Path, width: int, height: int, bytes_per_pixel: int) -> None:
    """Raise InputError for a size that no file of this length can hold, before memory is asked for."""
    promised = width * height * bytes_per_pixel
    if promised > max(ANY_FILE, MAX_EXPANSION * path.stat().st_size):
        raise InputError(
            f"{path}: size: {width} × {height} pixels are more than the file can hold; export it again"
        )


def write_png(path: str | Path, image: np.ndarray) -> None:
    """Write an (H, W, 3 or 4) image, sRGB-encoded values in [0, 1] (clipped), as 8-bit PNG, atomically.

    Raises InputError if the path cannot be written.
    """
    from PIL import Image

    pixels = np.round(np.clip(np.nan_to_num(image), 0, 1) * 255).astype(np.uint8)
    replace_file(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG"))


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of an EXR file's first part by name, float32 (H, W) each.

    Raises InputError if the file is missing, unreadable or holds NaN or infinite values.
    """
    return _read_exr(Path(path))[0]


def read_exr_image(path: str | Path) -> np.ndarray:
    """EXR file as float32 (H, W, C): C = 4 for R, G, B, A, 3 for R, G, B, or X, Y, Z, 1 for a single channel.

    Raises InputError as `read_exr` does, if the file has none of these sets of channels, and for colours in
    other primaries than those of linear sRGB.
    """
    channels, header = _read_exr(Path(path))
    primaries = header.get("chromaticities", SRGB_CHROMATICITIES)
    if "R" in channels and not np.allclose(primaries, SRGB_CHROMATICITIES, atol=CHROMATICITY_TOLERANCE):
        raise InputError(f"{path}: chromaticities: not those of sRGB; convert the image to linear sRGB")
    for names in ("RGBA", "RGB", "XYZ"):
        if set(names) <= channels.keys():
            return np.stack([channels[name] for name in names], axis=-1)
    if len(channels) == 1:
        return next(iter(channels.values()))[..., None]
    found = ", ".join(sorted(channels))
    raise InputError(f"{path}: channels: found {found}; export R, G, B (and A), or X, Y, Z, or one channel")


def _exr_size(path: Path) -> tuple[int, int]:
    """Width and height of an EXR file's data window; raises InputError for a header that makes no sense.

    Only one part of flat pixels passes. Layout: OpenEXR's file format (magic, version, attributes of name,
    type, length and value up to an empty name).
    """
    _require_file(path)
    try:
        with path.open("rb") as file:
            header = file.read(MAX_EXR_HEADER)
        magic, version = struct.unpack_from("<4sI", header)
        if magic != EXR_MAGIC or version & EXR_OTHER_FLAGS:
            raise ValueError("no EXR file, or one of several parts or of deep pixels")
        position, found = 8, {}
        while header[position] != 0:
            name, kind, rest = header[position:].split(b"\0", 2)
            position += len(name) + len(kind) + 2
            (length,) = struct.unpack_from("<I", rest)
            found[name] = header[position + 4 : position + 4 + length]
            position += 4 + length
        left, top, right, bottom = struct.unpack("<4i", found[b"dataWindow"])
        size, channels, pixel = (right - left + 1, bottom - top + 1), found[b"channels"], 0
        while channels[0] != 0:
            name, channels = channels.split(b"\0", 1)
            pixel += EXR_BYTES[struct.unpack_from("<I", channels)[0]]
            channels = channels[EXR_CHANNEL - 1 :]
        if min(size) < 1:
            raise ValueError("an empty data window")
    except OSError as error:
        raise InputError(f"{path}: file: cannot be read ({error.strerror}); check the path") from error
    except (ValueError, KeyError, IndexError, struct.error) as error:
        raise InputError(f"{path}: header: not a readable EXR file ({error}); export it again") from error
    _check_size(path, *size, pixel)
    return size


def _read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Channels and header of the first part."""
    import OpenEXR

    _exr_size(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels, dtype=np.float32) for name, c in file.channels().items()}
            header = dict(file.header())
    except Exception as error:  # the binding raises RuntimeError, TypeError or its own types
        raise InputError(f"{path}: pixels: not a readable EXR file ({error}); export it again") from error
    for name, pixels in channels.items():
        bad = np.argwhere(~np.isfinite(pixels))
        if len(bad):
            row, column = bad[0]
            raise InputError(
                f"{path}: channel {name}: {len(bad)} NaN or infinite values, the first at row {row}, "
                f"column {column}; render the image again"
            )
    return channels, header


def read_hdr(path: str | Path) -> np.ndarray:
    """Radiance picture (.hdr) as linear float32 (H, W, 3); rows from the top, run lengths or none.

    Written here because Mitsuba's reader writes beyond its memory where a run is longer than its row. Layout:
    Ward, "Real Pixels", 1991. Raises InputError if the file is missing or no such picture.
    """
    path = Path(path)
    _require_file(path)
    data = path.read_bytes()
    size = re.search(rb"\n\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:MAX_HDR_HEADER])
    if not data.startswith(b"#?") or b"32-bit_rle_xyze" in data[:MAX_HDR_HEADER] or size is None:
        raise InputError(f"{path}: header: no Radiance picture of rows from the top; save it as EXR")
    height, width = int(size.group(1)), int(size.group(2))
    _check_size(path, width, height, 4)
    rgbe, position = np.empty((height, width, 4), np.uint8), size.end()
    marker = bytes((2, 2, width >> 8 & 255, width & 255))
    try:
        for row in rgbe:
            if data[position : position + 4] != marker or not 8 <= width < 32768:
                row[:] = np.frombuffer(data, np.uint8, 4 * width, position).reshape(width, 4)
                position += 4 * width
                continue
            position += 4
            for channel in range(4):
                values, position = _runs(data, position, width)
                row[:, channel] = np.frombuffer(values, np.uint8)
    except (IndexError, ValueError) as error:
        raise InputError(f"{path}: pixels: truncated or broken; export it again") from error
    scale = np.where(rgbe[..., 3:] > 0, np.ldexp(1.0, rgbe[..., 3:].astype(int) - 136), 0)
    return (rgbe[..., :3] * scale).astype(np.float32)


def _runs(data: bytes, position: int, width: int) -> tuple[bytes, int]:
    """One channel of a row of a Radiance picture, and where the next begins; ValueError if it is too long."""
    values = bytearray()
    while len(values) < width:
        count = data[position]
        if count > 128:
            values += data[position + 1 : position + 2] * (count - 128)
            position += 2
        else:
            values += data[position + 1 : position + 1 + count]
            position += 1 + count
        if not count:
            raise ValueError("an empty run")
    if len(values) > width:
        raise ValueError("a run longer than its row")
    return bytes(values), position


def write_exr(path: str | Path, image: np.ndarray, names: str | None = None, half: bool = False) -> None:
    """Write an (H, W, C) or (H, W) array as ZIP-compressed float32 (or float16) EXR, atomically.

    `names` holds one letter a channel; by default Y, RGB or RGBA by the number of channels. Raises InputError
    if the path cannot be written.
    """
    import OpenEXR

    image = np.asarray(image)
    planes = image[..., None] if image.ndim == 2 else image
    names = names or {1: "Y", 3: "RGB", 4: "RGBA"}[planes.shape[-1]]
    dtype = np.float16 if half else np.float32
    channels = {name: np.ascontiguousarray(planes[..., i], dtype=dtype) for i, name in enumerate(names)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    replace_file(path, lambda temporary: OpenEXR.File(header, channels).write(str(temporary)))


@contextlib.contextmanager
def mitsuba_exr() -> Iterator[None]:
    """Give Dr.Jit a second thread, if it has but one, while Mitsuba itself may read or write EXR files."""
    import drjit as dr

    before = dr.thread_count()
    if before >= MITSUBA_EXR_THREADS:
        yield
        return
    dr.sync_thread()
    dr.set_thread_count(MITSUBA_EXR_THREADS)
    try:
        yield
    finally:
        dr.sync_thread()
        dr.set_thread_count(before)


def _require_file(path: Path) -> None:
    if not is_file(path):
        raise InputError(f"{path}: file: missing; restore it, or remove what refers to it")
