"""Radiance images (.hdr) as NumPy arrays."""

import re
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import check_size, require_file
from mi_refgs.io.progress import note

SIZE = re.compile(rb"\n\r?\n([-+])([XY]) (\d{1,9}) ([-+])([XY]) (\d{1,9})\r?\n")
MAX_VALUE = 1e28  # to which values are clipped before arithmetic
SRGB_FROM_XYZ = np.linalg.inv(((0.4124, 0.2126, 0.0193), (0.3576, 0.7152, 0.1192), (0.1805, 0.0722, 0.9505)))
"""From the right, of IEC 61966-2-1."""
SCALES = np.append(0, np.ldexp(1.0, np.arange(1, 256) - 136)).astype(np.float32)
"""Factor of red, green and blue by the byte of their exponent."""


def read_hdr(path: Path) -> np.ndarray:
    """A Radiance image (Ward, "Real Pixels", 1991) as linear float32 (H, W, 3) with its top in the first row,
    divided by its exposure, and converted from XYZ; raises InputError. Mitsuba's reader writes out of bounds
    where a run is longer than its row."""
    require_file(path)
    data = path.read_bytes()
    size = SIZE.search(data[: 2**16])
    if not data.startswith(b"#?") or size is None or size[2] == size[5]:
        raise InputError("no Radiance image with a line as -Y 512 +X 1024", path, "header", "save it as EXR")
    signs, height, width = {size[2]: size[1], size[5]: size[4]}, int(size[3]), int(size[6])
    check_size(path, width, height, 4)
    rgbe, position = np.empty((height, width, 4), np.uint8), size.end()
    try:
        for row in rgbe:
            position = _row(data, position, row)
    except (IndexError, ValueError) as error:
        raise InputError("truncated or broken", path, "pixels", "export it again") from error
    image = _calibrated(path, data[: size.start()], rgbe[..., :3] * SCALES[rgbe[..., 3:]])
    if size[2] == b"X":  # the file's rows are columns
        image = image.swapaxes(0, 1)
    return image[:: 1 if signs[b"Y"] == b"-" else -1, :: 1 if signs[b"X"] == b"+" else -1]


def _calibrated(path: Path, header: bytes, image: np.ndarray) -> np.ndarray:
    """The radiance of pixels, which all EXPOSURE and COLORCORR lines of a header have multiplied."""
    factor = np.ones(3)
    try:
        for values in re.findall(rb"^(?:EXPOSURE|COLORCORR) *=(.*)", header, re.MULTILINE):
            factor *= np.array(values.split(), float)
        if not (factor > 1e-9).all():
            raise ValueError("not positive")
    except ValueError as error:
        raise InputError(f"no numbers ({error})", path, "EXPOSURE, COLORCORR", "correct them") from error
    if (factor != 1).any():
        note(path, f"values are divided by {factor.round(6)}, by EXPOSURE and COLORCORR of its header")
        image = (np.minimum(image, MAX_VALUE) / factor).astype(np.float32)
    if b"32-bit_rle_xyze" in header:
        note(path, "XYZ is converted to linear sRGB")
        image = np.minimum(image, MAX_VALUE) @ SRGB_FROM_XYZ.astype(np.float32)
    return image


def _row(data: bytes, position: int, row: np.ndarray) -> int:
    """Decode a row (W, 4) in any of the three codings; returns the position of the next one."""
    width = len(row)
    if 8 <= width < 32768 and data[position : position + 4] == bytes((2, 2, width >> 8, width & 255)):
        position += 4
        for channel in range(4):
            values = bytearray()
            while len(values) < width:
                count, position = data[position], position + 1
                if count > 128:
                    values += data[position : position + 1] * (count - 128)
                    position += 1
                else:
                    values += data[position : position + count]
                    position += count
            row[:, channel] = np.frombuffer(values, np.uint8)  # fails if a run is longer than its row
        return position
    count = min(width, (len(data) - position) // 4)
    pixels = np.frombuffer(data, np.uint8, 4 * max(count, 0), position).reshape(-1, 4)
    repeats = (pixels[:, :3] == 1).all(axis=1)  # the old coding: 1 1 1 N repeats the pixel before N times
    if not repeats.any():
        row[:] = pixels.reshape(row.shape)  # fails at the end of the file
        return position + 4 * width
    index = np.arange(count)
    last = np.maximum.accumulate(np.where(repeats, -1, index))
    if last[0] < 0:
        raise ValueError("a run before any pixel")
    digit = 8 * np.minimum(index - last - 1, 3)  # of a series of runs, each next one counts 256 times as much
    counts = np.where(repeats, pixels[:, 3].astype(np.int64) << np.maximum(digit, 0), 1)
    used = int(np.searchsorted(np.cumsum(counts), width)) + 1
    if counts[:used].sum() != width:
        raise ValueError("a run longer than its row")
    row[:] = np.repeat(pixels[last[:used]], counts[:used], axis=0)
    return position + 4 * used
