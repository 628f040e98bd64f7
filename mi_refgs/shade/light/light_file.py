"""Lat-long images of lights."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.io.exr import EXR_MAGIC, read_exr_image
from mi_refgs.io.hdr import read_hdr
from mi_refgs.io.images import linear_from_srgb, read_bytes
from mi_refgs.shade.light.lobe_matrices import resample

MAX_ROWS = 4096  # most rows that are kept of a map: 400 MB of float32


def read_radiance(path: str | os.PathLike[str], rows: int = MAX_ROWS) -> np.ndarray:
    """Linear radiance (h, w, 3) float32 ≥ 0 of a lat-long EXR, HDR, PNG or JPEG file, averaged to at most
    `rows` rows and 2 · `rows` columns. Raises InputError for other images and above `files.MAX_PIXELS`."""
    path = Path(path)
    image = np.maximum(_read(path), 0)
    height, width, _ = image.shape
    if min(height, width) < 2:
        size = f"{width} × {height} pixels"
        raise InputError(f"{size} are no lat-long image", path, "environment", "give 2 × 2 at least")
    return np.ascontiguousarray(resample(image, min(height, rows), min(width, 2 * rows)))


def _read(path: Path) -> np.ndarray:
    """Linear radiance (h, w, 3) float32 of a file, whose first bytes say which format it is."""
    try:
        with path.open("rb") as file:
            first = file.read(4)
    except OSError as error:
        what = f"cannot be read ({error.strerror})"
        raise InputError(what, path, "environment", "give an EXR or HDR file") from error
    if first[:2] == b"#?":
        return read_hdr(path)
    if first == EXR_MAGIC:
        image = read_exr_image(path)
        return image[..., :3] if image.shape[2] > 2 else np.repeat(image[..., :1], 3, axis=-1)
    pixels = read_bytes(path)[0][..., :3].astype(np.float32)
    return np.asarray(linear_from_srgb(pixels / np.float32(255)))
