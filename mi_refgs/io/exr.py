"""EXR files as NumPy arrays, written whole or not.

Mitsuba's own EXR files are left to it only where it loads or saves a scene (`mitsuba_exr` says why).
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import check_size, replace_file, require_file, strip_rows

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
SRGB_CHROMATICITIES = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)
"""x, y of red, green, blue and white (ITU-R BT.709), which an EXR file without the attribute has."""
CHROMATICITY_TOLERANCE = 1e-3
"""Half the last digit that standards give, and far below the difference between any two of them."""
MITSUBA_EXR_THREADS = 2
"""Mitsuba 3.9 reads and writes EXR files on a worker thread; with one thread in all, it never returns."""


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of an EXR file's first part by name, float32 (H, W) each.

    Raises InputError if the file is missing, unreadable or holds NaN or infinite values.
    """
    return _read_exr(Path(path))[0]


def read_exr_image(path: str | Path, vectors: bool = False) -> np.ndarray:
    """EXR file as float32 (H, W, C): R, G, B, A; R, G, B; Y, A; or a single channel.

    `vectors`: X, Y, Z, too, which are no colours. Raises InputError as `read_exr` does, if the file has none
    of these sets of channels, and for colours in other primaries than those of linear sRGB.
    """
    channels, header = _read_exr(Path(path))
    names = _chosen(Path(path), channels.keys(), header, vectors)
    return np.stack([channels[name] for name in names], axis=-1)


def _chosen(path: Path, channels: Collection[str], header: Mapping[str, Any], vectors: bool) -> list[str]:
    """The channels of an image by their names, in order; raises InputError as `read_exr_image` does."""
    primaries = header.get("chromaticities", SRGB_CHROMATICITIES)
    if "R" in channels and not np.allclose(primaries, SRGB_CHROMATICITIES, atol=CHROMATICITY_TOLERANCE):
        raise InputError(f"{path}: chromaticities: not those of sRGB; convert the image to linear sRGB")
    for names in ("RGBA", "RGB", *(("XYZ",) if vectors else ()), "YA"):
        if set(names) <= set(channels):
            return list(names)
    if len(channels) == 1:
        return list(channels)
    found, wanted = ", ".join(sorted(channels)), "X, Y, Z, " if vectors else ""
    raise InputError(
        f"{path}: channels: found {found}; export R, G, B (and A), {wanted}or one channel (and A)"
    )


def exr_strips(path: Path) -> tuple[tuple[int, int], Iterator[np.ndarray]]:
    """Height and width of an EXR file, and its rows from the top in linear float32 (n, W, 3).

    One channel, with or without alpha, is grey. Raises InputError as `read_exr_image` does, but leaves NaN
    and infinite values to the caller; the strips raise it where they are broken.
    """
    width, height = exr_size(path)
    names = _header(path)
    return (height, width), _strips(path, names[:3] if len(names) > 2 else names[:1], width, height)


def exr_has_alpha(path: Path) -> bool:
    """Whether `read_exr_image` gives alpha beside a colour, by the header; raises InputError as that does."""
    exr_size(path)
    return len(_header(path)) == 4


def _header(path: Path) -> list[str]:
    """The channels that `read_exr_image` takes."""
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            header, found = dict(file.header()), file.header()["channels"]
    except Exception as error:  # the binding raises RuntimeError, TypeError or its own types
        raise _unreadable(path, error) from error
    return _chosen(path, [channel.name for channel in found], header, False)


def _strips(path: Path, names: list[str], width: int, height: int) -> Iterator[np.ndarray]:
    """Rows of three channels, or of one as three."""
    import Imath
    import OpenEXR

    kind, step = Imath.PixelType(Imath.PixelType.FLOAT), strip_rows(width)
    try:
        file = OpenEXR.InputFile(str(path))  # `OpenEXR.File` reads all rows
        first = file.header()["dataWindow"].min.y
        for top in range(0, height, step):
            count = min(step, height - top)
            rows = file.channels(names, kind, first + top, first + top + count - 1)
            planes = [np.frombuffer(row, np.float32).reshape(count, width) for row in rows]
            yield np.stack(planes * (3 // len(planes)), axis=-1)
    except Exception as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(f"{path}: pixels: not a readable EXR file ({error}); export it again")


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height of an EXR file's data window; raises InputError for a header that makes no sense.

    Only one part of flat pixels passes. Layout: OpenEXR's file format (magic, version, attributes of name,
    type, length and value up to an empty name).
    """
    require_file(path)
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
    check_size(path, *size, pixel)
    return size


def _read_exr(path: Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Channels and header of the first part."""
    import OpenEXR

    exr_size(path)
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(c.pixels, dtype=np.float32) for name, c in file.channels().items()}
            header = dict(file.header())
    except Exception as error:  # the binding raises RuntimeError, TypeError or its own types
        raise _unreadable(path, error) from error
    for name, pixels in channels.items():
        bad = np.argwhere(~np.isfinite(pixels))
        if len(bad):
            row, column = bad[0]
            raise InputError(
                f"{path}: channel {name}: {len(bad)} NaN or infinite values, the first at row {row}, "
                f"column {column}; render the image again"
            )
    return channels, header


def write_exr(path: str | Path, image: np.ndarray, names: str | None = None, half: bool = False) -> None:
    """Write an (H, W, C) or (H, W) array as ZIP-compressed float32 (or float16) EXR, atomically.

    `names` holds one letter a channel; by default Y, RGB or RGBA by the number of channels. Raises InputError
    if the path cannot be written.
    """
    image = np.asarray(image)
    planes = image[..., None] if image.ndim == 2 else image
    names = names or {1: "Y", 3: "RGB", 4: "RGBA"}[planes.shape[-1]]
    dtype = np.float16 if half else np.float32
    write_exr_layers(path, {name: planes[..., i].astype(dtype) for i, name in enumerate(names)})


def write_exr_layers(path: str | Path, layers: Mapping[str, np.ndarray]) -> None:
    """Write (H, W) arrays of float32 or float16 by name of channel, ZIP-compressed, atomically.

    Raises InputError if the path cannot be written.
    """
    import OpenEXR

    channels = {name: np.ascontiguousarray(plane) for name, plane in layers.items()}
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
