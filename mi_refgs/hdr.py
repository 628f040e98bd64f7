"""Radiance pictures (.hdr) as NumPy arrays."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.files import check_size, require_file

MAX_HDR_HEADER = 2**16
"""Bytes in which the size of a Radiance picture must stand."""


def read_hdr(path: str | Path) -> np.ndarray:
    """Radiance picture (.hdr) as linear float32 (H, W, 3); rows from the top, run lengths or none.

    Written here because Mitsuba's reader writes beyond its memory where a run is longer than its row. Layout:
    Ward, "Real Pixels", 1991. Raises InputError if the file is missing or no such picture.
    """
    path = Path(path)
    require_file(path)
    data = path.read_bytes()
    size = re.search(rb"\n\n-Y (\d{1,9}) \+X (\d{1,9})\n", data[:MAX_HDR_HEADER])
    if not data.startswith(b"#?") or b"32-bit_rle_xyze" in data[:MAX_HDR_HEADER] or size is None:
        raise InputError(f"{path}: header: no Radiance picture of rows from the top; save it as EXR")
    height, width = int(size.group(1)), int(size.group(2))
    check_size(path, width, height, 4)
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
