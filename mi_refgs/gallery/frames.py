"""Pictures as WebP files, still or moving. A picture is (H, W, 3), display-encoded, in [0, 1]."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import to_8_bits

QUALITY = 75
"""Of WebP, 0 to 100: fine texture stays, and a sheet is a tenth of its PNG."""
EFFORT = 6
"""Of its encoder, 0 to 6: small files are worth the seconds."""


def write_still(path: Path, picture: np.ndarray) -> None:
    """Write one picture, atomically; raises InputError where it cannot be written."""
    _write(path, [picture])


def write_turntable(path: Path, frames: Sequence[np.ndarray], seconds: float) -> None:
    """Write pictures of one size as an animation without end, one turn in so many seconds; likewise."""
    _write(path, frames, duration=round(1000 * seconds / len(frames)), loop=0)


def _write(path: Path, frames: Sequence[np.ndarray], **options: Any) -> None:
    from PIL import Image

    first, *others = (Image.fromarray(to_8_bits(frame)) for frame in frames)
    buffer = io.BytesIO()
    first.save(
        buffer, "WEBP", save_all=bool(others), append_images=others, quality=QUALITY, method=EFFORT, **options
    )
    write_bytes(path, buffer.getvalue())
