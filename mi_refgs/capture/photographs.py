"""Photographs as a camera left them: which way up, of which focal length, and reduced copies to work on."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import MAX_SIZES
from mi_refgs.errors import InputError
from mi_refgs.io.files import replace_file
from mi_refgs.io.images import ENDINGS, exif_tags, open_image

OTHER_ENDINGS = (
    ".heic",
    ".heif",
    ".dng",
    ".cr2",
    ".cr3",
    ".nef",
    ".arw",
    ".raf",
    ".tif",
    ".tiff",
    ".webp",
    ".avif",
)
"""Formats of cameras that are not read here, for a message that says what to do."""
FEWEST = 3
"""Photographs with which a triangulated point can be checked by a third view."""
DIAGONAL_35MM = 43.2666
"""Diagonal of a frame of 36 mm × 24 mm, mm, to which EXIF's 35 mm equivalent of a focal length relates."""
ORIENTATION, MAKE, MODEL, FOCAL, FOCAL_35MM = 0x0112, 0x010F, 0x0110, 0x920A, 0xA405
"""EXIF tags."""
TURNS = {
    2: "FLIP_LEFT_RIGHT",
    3: "ROTATE_180",
    4: "FLIP_TOP_BOTTOM",
    5: "TRANSPOSE",
    6: "ROTATE_270",
    7: "TRANSVERSE",
    8: "ROTATE_90",
}
"""Pillow's names of what displays stored pixels upright, by EXIF's orientation."""
SIDEWAYS = (5, 6, 7, 8)
"""Values of EXIF's orientation that swap width and height."""


@dataclass(frozen=True)
class Photograph:
    """A picture file, and how its pixels lie in the data set."""

    path: Path
    digest: str  # SHA-256 of the file
    size: tuple[int, int]  # width and height as displayed, pixels
    focal: float | None  # focal length over the picture's diagonal, where EXIF tells it
    device: str  # what took it: pictures of one camera and lens share it
    plain: bool = True  # colour or grey without alpha
    orientation: int = 1  # EXIF's: how the stored pixels are turned for display
    lying: bool = False  # whether it is kept a quarter turn anticlockwise, as the others' sensor lay
    number: int = 0  # its place in the order of names

    @property
    def name(self) -> str:
        """File name of its picture in the data set."""
        return self.path.name

    @property
    def copy(self) -> str:
        """File name of its working copy; without spaces, at which COLMAP splits lists of names."""
        return f"{self.number:05}.png"

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height of the pixels in the file."""
        return self.size[::-1] if self.orientation in SIDEWAYS else self.size

    @property
    def as_displayed(self) -> bool:
        """Whether the file can serve as it is: its pixels lie as those of the data set and are opaque."""
        return self.orientation == 1 and not self.lying and self.plain

    @property
    def kept_size(self) -> tuple[int, int]:
        """Width and height in the data set, before its lens is undone."""
        return self.size[::-1] if self.lying else self.size

    @property
    def up(self) -> tuple[float, float]:
        """The direction that was up when it was taken, in pixels (right, down) of the data set's picture."""
        return (-1.0, 0.0) if self.lying else (0.0, -1.0)

    def focal_pixels(self, size: tuple[int, int]) -> float | None:
        """The focal length in pixels of a copy of this size."""
        return None if self.focal is None else self.focal * float(np.hypot(*size))

    def load(self, longest: int | None = None) -> Any:
        """The picture as it lies in the data set, an RGB PIL image of at most so many pixels a side.

        Raises InputError for a file that is no readable picture of 8 bits a channel.
        """
        from PIL import Image

        with open_image(self.path) as picture:
            if picture.mode.startswith(("I", "F")):
                raise InputError(
                    f"{self.path}: pixels: more than 8 bits per channel; save it as JPEG or 8-bit PNG"
                )
            factor = 1.0 if longest is None else max(1.0, max(picture.size) / longest)
            wanted = tuple(max(1, round(side / factor)) for side in picture.size)
            if factor >= 2:
                picture.draft("RGB", wanted)  # JPEG decodes smaller for less
            copy = picture.convert("RGB")
            copy.info = {}
        if copy.size != wanted:
            copy = copy.resize(wanted, Image.Resampling.LANCZOS)
        return self.turned(copy)

    def turned(self, stored: Any) -> Any:
        """A PIL image that lies as the stored pixels do, turned as the picture lies in the data set."""
        from PIL.Image import Transpose

        upright = (
            stored.transpose(Transpose[TURNS[self.orientation]]) if self.orientation in TURNS else stored
        )
        return upright.transpose(Transpose.ROTATE_90) if self.lying else upright

    def exif(self) -> bytes:
        """The EXIF data of a picture that lies as displayed; empty where the file's are broken."""
        with open_image(self.path) as picture:
            try:
                data = picture.getexif()
                data[ORIENTATION] = 1
                return bytes(data.tobytes())
            except Exception:  # Pillow raises many types for broken EXIF data
                return b""


def find_photographs(folder: Path) -> list[Photograph]:
    """The pictures of a folder by name, all lying as most of them do.

    Portraits among landscapes of one camera, and the reverse, are kept lying on their side: they have the
    same sensor, so one size and one lens serve all.

    Raises InputError for no folder, too few pictures, pictures of many sizes, and files that are none.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: photographs: no such folder; give one with JPEG or PNG files")
    files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    paths = [path for path in files if path.suffix.lower() in ENDINGS]
    if len(paths) < FEWEST:
        other = Counter(path.suffix for path in files if path.suffix.lower() in OTHER_ENDINGS).most_common(1)
        remedy = (
            f"convert its {other[0][0]} files to JPEG"
            if other
            else "photograph the object from all sides, 30 to 100 times"
        )
        found = {0: "no JPEG or PNG file", 1: "one picture"}.get(len(paths), f"{len(paths)} pictures")
        raise InputError(f"{folder}: photographs: {found}; {remedy}")
    found_all = [_photograph(path) for path in paths]
    most = Counter(photograph.size for photograph in found_all).most_common(1)[0][0]
    kept = [
        replace(p, lying=p.size != most and p.size[::-1] == most, number=i) for i, p in enumerate(found_all)
    ]
    sizes = {p.kept_size: p.name for p in kept}
    if len(sizes) > MAX_SIZES:
        some = ", ".join(f"{width} × {height} ({name})" for (width, height), name in [*sizes.items()][:3])
        raise InputError(
            f"{folder}: photographs: {len(sizes)} different sizes, such as {some}, and a fit takes "
            f"{MAX_SIZES} at most; leave out those that were cropped"
        )
    return kept


def _photograph(path: Path) -> Photograph:
    with open_image(path) as picture:
        exif, detail = exif_tags(picture)
        size, plain = picture.size, picture.mode in ("RGB", "L")
    said = exif.get(ORIENTATION, 1)
    orientation = int(said) if said in range(1, 9) else 1
    size = size[::-1] if orientation in SIDEWAYS else size
    equivalent, own = _positive(detail.get(FOCAL_35MM)), _positive(detail.get(FOCAL))
    device = f"{exif.get(MAKE, '')} {exif.get(MODEL, '')} {own or equivalent or ''}"
    focal = None if equivalent is None else equivalent / DIAGONAL_35MM
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    return Photograph(path, digest, size, focal, device, plain, orientation)


def _positive(value: Any) -> float | None:
    """A number of EXIF, which may be a fraction with a denominator of 0, or anything."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0 < number < np.inf else None


def write_copies(photographs: Sequence[Photograph], folder: Path, longest: int, progress: Any) -> None:
    """Copies to work on, of at most `longest` pixels a side, those that are not there yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for photograph in progress(photographs):
        file = folder / photograph.copy
        if not file.is_file():
            picture = photograph.load(longest)
            replace_file(file, partial(picture.save, format="PNG", compress_level=1))


def cameras_of(photographs: Sequence[Photograph]) -> list[list[Photograph]]:
    """The photographs by the camera and lens that took them: of one size, device and focal length."""
    groups: dict[tuple[Any, ...], list[Photograph]] = {}
    for photograph in photographs:
        groups.setdefault((photograph.kept_size, photograph.device, photograph.focal), []).append(photograph)
    return list(groups.values())
