"""Radiance images (.hdr) as NumPy arrays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.files import check_size, require_file

MAX_HDR_HEADER = 2**16  # bytes within which the size of a Radiance image must be given
SCALES = np.append(0, np.ldexp(1.0, np.arange(1, 256) - 136)).astype(np.float32)
"""Factor of red, green and blue by the byte of their exponent."""


def read_hdr(path: Path) -> np.ndarray:
    """A Radiance image (Ward, "Real Pixels", 1991) as linear float32 (H, W, 3); raises InputError. Mitsuba's
    reader writes out of bounds where a run is longer than its row."""
    require_file(path)
    data = path.read_bytes()
    size = re.search(rb"\n\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:MAX_HDR_HEADER])
    if not data.startswith(b"#?") or b"32-bit_rle_xyze" in data[:MAX_HDR_HEADER] or size is None:
        raise InputError("no Radiance image of rows from the top", path, "header", "save it as EXR")
    height, width, position = int(size.group(1)), int(size.group(2)), size.end()
    check_size(path, width, height, 4)
    marker = bytes((2, 2, width >> 8 & 255, width & 255))
    rgbe = np.empty((height, width, 4), np.uint8)
    try:
        for row in rgbe:  # run-length encoded or not
            if data[position : position + 4] != marker or not 8 <= width < 32768:
                row[:] = np.frombuffer(data, np.uint8, 4 * width, position).reshape(width, 4)
                position += 4 * width
                continue
            position += 4
            for channel in range(4):
                values, position = _runs(data, position, width)
                row[:, channel] = np.frombuffer(values, np.uint8)
    except (IndexError, ValueError) as error:
        raise InputError("truncated or broken", path, "pixels", "export it again") from error
    return rgbe[..., :3] * SCALES[rgbe[..., 3:]]


def _runs(data: bytes, position: int, width: int) -> tuple[bytes, int]:
    """One channel of a row, and the position of the next; raises ValueError if it is too long."""
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
