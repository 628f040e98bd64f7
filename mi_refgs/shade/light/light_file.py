"""Lat-long images of lights: read in strips of rows and averaged on the way, so that none is whole in memory.

A map of 16,384 × 8,192 pixels is 1.6 GB of float32, and a light has a few hundred rows.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.exr import EXR_MAGIC, exr_strips
from mi_refgs.io.files import strip_rows
from mi_refgs.io.hdr import hdr_strips
from mi_refgs.io.images import linear_from_srgb, read_bytes
from mi_refgs.shade.light.lobe_matrices import resampling

MAX_ROWS = 4096
"""Most rows that are kept of a map, unless the caller wants fewer: 400 MB of float32 with their columns."""


def read_radiance(path: str | os.PathLike[str], rows: int = MAX_ROWS) -> np.ndarray:
    """Linear radiance (h, w, 3) float32, at least 0, of a lat-long EXR, HDR, PNG or JPEG file.

    A map of more than `rows` rows or 2 · `rows` columns is averaged to that many, keeping its integral as
    `lobe_matrices.resample` does; a smaller one comes as it is. Raises InputError when it is no such image,
    and for one of more than `files.MAX_PIXELS`, before any pixel is decoded.
    """
    path = Path(path)
    (height, width), strips = _strips(path)
    if min(height, width) < 2:
        size = f"{width} × {height} pixels"
        raise InputError(f"{size} are no lat-long image", path, "environment", "give 2 × 2 at least")
    h, w = min(height, rows), min(width, 2 * rows)
    image = np.zeros((h, w, 3), np.float32)
    down = None if h == height else resampling(height, h).astype(np.float32)
    across = None if w == width else resampling(width, w, periodic=True).astype(np.float32)
    top = 0
    for strip in strips:
        if not np.isfinite(strip).all():
            row, column, _ = np.argwhere(~np.isfinite(strip))[0]
            raise InputError(
                f"NaN or infinite values, the first at row {top + row}, column {column}",
                path,
                "environment",
                "replace those texels",
            )
        part, count = np.maximum(strip, 0), len(strip)
        if across is not None:
            columns = across @ part.transpose(1, 0, 2).reshape(width, -1)
            part = columns.reshape(w, count, 3).transpose(1, 0, 2)
        if down is None:
            image[top : top + count] = part
        else:
            share = down[:, top : top + count]
            touched = np.flatnonzero(np.diff(share.indptr))
            image[touched] += (share[touched] @ part.reshape(count, -1)).reshape(-1, w, 3)
        top += count
    return image


def _strips(path: Path) -> tuple[tuple[int, int], Iterator[np.ndarray]]:
    """Height and width of an EXR, Radiance (.hdr), PNG or JPEG file, and its rows from the top.

    They come as linear radiance in arrays (n, width, 3) float32. The first bytes say which format it is.
    """
    try:
        with path.open("rb") as file:
            first = file.read(4)
    except OSError as error:
        failed = f"cannot be read ({error.strerror})"
        raise InputError(failed, path, "environment", "give an EXR or HDR file") from error
    if first[:2] == b"#?":
        return hdr_strips(path)
    if first == EXR_MAGIC:
        return exr_strips(path)
    pixels = read_bytes(path)[0][..., :3]
    step = strip_rows(pixels.shape[1])
    strips = (pixels[top : top + step].astype(np.float32) for top in range(0, len(pixels), step))
    return pixels.shape[:2], (linear_from_srgb(strip / np.float32(255)) for strip in strips)
