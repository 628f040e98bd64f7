"""EXR files as NumPy arrays, written atomically."""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import check_size, replace_file, require_file

EXR_MAGIC = b"\x76\x2f\x31\x01"  # first bytes of every EXR file
SAMPLE_BYTES = 2  # bytes per sample at least: those of half floats; integers and floats have 4
SRGB = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # x, y of R, G, B, white (BT.709)
CHROMATICITY_TOLERANCE = 1e-3  # half the last digit in standards
MITSUBA_EXR_THREADS = 2  # Mitsuba 3.9 uses a worker thread for EXR files: with one in all, it never returns


def read_exr(path: str | Path) -> dict[str, np.ndarray]:
    """All channels of an EXR file by name, float32 (H, W) each; raises InputError unless all are finite."""
    import OpenEXR

    path = Path(path)
    exr_size(path)
    with _readable(path), OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(c.pixels, dtype=np.float32) for name, c in file.channels().items()}
    for name, pixels in channels.items():
        if len(bad := np.argwhere(~np.isfinite(pixels))):
            what = f"{len(bad)} NaN or infinite values, the first at row {bad[0, 0]}, column {bad[0, 1]}"
            raise InputError(what, path, f"channel {name}", "render the image again")
    return channels


def read_exr_image(path: str | Path, vectors: bool = False) -> np.ndarray:
    """EXR file as float32 (H, W, C): RGBA, RGB, YA or one channel; with `vectors` also XYZ. Raises InputError
    as `read_exr`, without such channels, and for primaries other than sRGB's."""
    channels = read_exr(path)
    names = _image_channels(Path(path), channels, _header(Path(path)), vectors)
    return np.stack([channels[name] for name in names], axis=-1)


def exr_has_alpha(path: Path) -> bool:
    """Whether `read_exr_image` returns colour with alpha, by the header; raises InputError as that does."""
    exr_size(path)
    header = _header(path)
    return len(_image_channels(path, [channel.name for channel in header["channels"]], header, False)) == 4


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height of an EXR file's data window; raises InputError as `read_exr`."""
    require_file(path)
    header = _header(path)
    (left, top), (right, bottom) = header["dataWindow"]
    width, height = int(right) - int(left) + 1, int(bottom) - int(top) + 1
    check_size(path, width, height, SAMPLE_BYTES * len(header["channels"]))
    return width, height


def _header(path: Path) -> dict[str, Any]:
    import OpenEXR

    with _readable(path, "header"), OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
        header = dict(file.header())
        if len(file.parts) > 1 or header["type"] not in (OpenEXR.scanlineimage, OpenEXR.tiledimage):
            raise ValueError("several parts, or deep pixels")
        (left, top), (right, bottom) = header["dataWindow"]
        if right < left or bottom < top:
            raise ValueError("an empty data window")
    return header


def _image_channels(
    path: Path, channels: Collection[str], header: Mapping[str, Any], vectors: bool
) -> list[str]:
    """The channels of an image, in order; raises InputError as `read_exr_image` does."""
    primaries = header.get("chromaticities", SRGB)
    if "R" in channels and not np.allclose(primaries, SRGB, atol=CHROMATICITY_TOLERANCE):
        raise InputError("not those of sRGB", path, "chromaticities", "convert the image to linear sRGB")
    for names in ("RGBA", "RGB", *(("XYZ",) if vectors else ()), "YA"):
        if set(names) <= set(channels):
            return list(names)
    if len(channels) == 1:
        return list(channels)
    remedy = f"export R, G, B (and A), {'X, Y, Z, ' if vectors else ''}or one channel (and A)"
    raise InputError(f"found {', '.join(sorted(channels))}", path, "channels", remedy)


@contextlib.contextmanager
def _readable(path: Path, field: str = "pixels") -> Iterator[None]:
    """Turn what OpenEXR raises (RuntimeError, TypeError or its own types) into InputError."""
    try:
        yield
    except Exception as error:
        raise InputError(f"not a readable EXR file ({error})", path, field, "export it again") from error


def write_exr(path: str | Path, image: np.ndarray, names: str | None = None, half: bool = False) -> None:
    """Write an (H, W, C) or (H, W) array as ZIP-compressed EXR, float32 or float16, atomically. `names` has
    one letter per channel, by default Y, RGB or RGBA. Raises InputError as `replace_file` does."""
    image = np.asarray(image)
    planes = image[..., None] if image.ndim == 2 else image
    names = names or {1: "Y", 3: "RGB", 4: "RGBA"}[planes.shape[-1]]
    dtype = np.float16 if half else np.float32
    write_exr_layers(path, {name: planes[..., i].astype(dtype) for i, name in enumerate(names)})


def write_exr_layers(path: str | Path, layers: Mapping[str, np.ndarray]) -> None:
    """Write (H, W) arrays of float32 or float16 by name of channel, as `write_exr` does."""
    import OpenEXR

    channels = {name: np.ascontiguousarray(plane) for name, plane in layers.items()}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    replace_file(path, lambda temporary: OpenEXR.File(header, channels).write(str(temporary)))


@contextlib.contextmanager
def mitsuba_exr() -> Iterator[None]:
    """Give Dr.Jit a second thread, if it has only one, while Mitsuba itself may read or write EXR files."""
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
