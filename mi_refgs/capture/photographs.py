"""Photographs and their masks: orientation, focal length, and reduced copies for feature detection."""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.dataset import MAX_SIZES, require_few_sizes
from mi_refgs.data.exposure import EXIF_EXPOSURE
from mi_refgs.data.images import MASK, image_files, is_copy, mask_in
from mi_refgs.errors import InputError, counted
from mi_refgs.io.images import exif_tags, image_header, open_image, positive, read_mask, to_8_bits
from mi_refgs.io.ownership import MARK, RUN, owner_of
from mi_refgs.io.progress import Tell

OTHER_ENDINGS = ".heic .heif .dng .cr2 .cr3 .nef .arw .raf .tif .tiff .avif".split()  # for a message
WORK = ".work"  # folder of working copies, features, matches and the model; it may be removed afterwards
REPORT = "capture.json"  # written last: with a folder WORK or this file, the folder is a capture
FEWEST = 3  # smallest number of photographs: a third view checks a triangulated point
ORIENTATION, MAKE, MODEL, FOCAL, FOCAL_35MM = 0x0112, 0x010F, 0x0110, 0x920A, 0xA405  # EXIF tags
SIDEWAYS = (5, 6, 7, 8)  # values of EXIF's orientation that swap width and height


@dataclass(frozen=True)
class Photograph:
    """An image file, and the orientation of its pixels in the data set."""

    path: Path
    name: str  # its path in the folder of photographs
    digest: str  # SHA-256 of the file
    size: tuple[int, int]  # width and height as displayed, pixels
    focal: float | None  # focal length over the image's diagonal, where EXIF tells it
    device: str  # camera and lens: photographs with the same one share intrinsics
    exposure: Mapping[int, Any]  # EXIF's tags that tell it
    plain: bool = True  # colour or grey without alpha
    cut_out: bool = False  # with transparent pixels
    orientation: int = 1  # EXIF's: how the stored pixels are turned for display
    lying: bool = False  # rotated by 90° anticlockwise in the data set, to have the sensor of the others
    number: int = 0  # index in the order of names

    @property
    def copy(self) -> str:
        """File name of its working copy; without spaces, at which COLMAP splits lists of names."""
        return f"{self.number:05}.png"

    @property
    def stored_size(self) -> tuple[int, int]:
        """Width and height of the pixels in the file."""
        return self.size[::-1] if self.orientation in SIDEWAYS else self.size

    @property
    def kept_size(self) -> tuple[int, int]:
        """Width and height in the data set, before undistortion."""
        return self.size[::-1] if self.lying else self.size

    @property
    def up(self) -> tuple[float, float]:
        """The upward direction when it was taken, (right, down) in the data set's image."""
        return (-1.0, 0.0) if self.lying else (0.0, -1.0)

    def load(self, longest: int | None = None) -> Any:
        """The image as oriented in the data set: an RGB PIL image of at most `longest` pixels per side."""
        from PIL import Image

        with open_image(self.path) as image:
            if image.mode.startswith(("I", "F")):
                remedy = "save it as JPEG or 8-bit PNG"
                raise InputError("more than 8 bits per channel", self.path, "pixels", remedy)
            factor = 1.0 if longest is None else max(1.0, max(image.size) / longest)
            wanted = tuple(max(1, round(side / factor)) for side in image.size)
            if factor >= 2:
                image.draft("RGB", wanted)  # JPEG decodes smaller for less
            copy = image.convert("RGB")
        if copy.size != wanted:
            copy = copy.resize(wanted, Image.Resampling.LANCZOS)
        return self.turned(copy, self.orientation)

    def turned(self, stored: Any, orientation: int) -> Any:
        """Rotate a PIL image from an orientation of EXIF to that of the data set."""
        from PIL import Image, ImageOps

        upright = Image.fromarray(np.asarray(stored))  # without EXIF data of its own
        upright.getexif()[ORIENTATION] = orientation
        upright = ImageOps.exif_transpose(upright)
        return upright.transpose(Image.Transpose.ROTATE_90) if self.lying else upright


def find_photographs(folder: Path, tell: Tell = lambda _: None) -> list[Photograph]:
    """The photographs of a folder by name, or of subfolders but captures and runs, rotated as most of them
    are: so all have one size and one lens; `tell` is called with what is not read. Raises InputError for too
    few images, many sizes, and unreadable files."""
    if not folder.is_dir():
        raise InputError("no such folder", folder, "photographs", "give one with JPEG or PNG files")
    paths, below = image_files(folder, deep=False), [*folder.rglob("*")]
    marked = [p for p in below if p.name in (REPORT, WORK, MARK)]  # folders of captures and runs
    made = {p.parent for p in marked if p.name != MARK or owner_of(p.parent) == RUN}
    inner = [p for p in image_files(folder, deep=True) if made.isdisjoint(p.parents)]
    inner = [p for p in inner if not any(map(MASK.search, p.relative_to(folder).parts[:-1]))]
    paths = inner if len(paths) < FEWEST else paths
    other = Counter(path.suffix for path in below if path.suffix.lower() in OTHER_ENDINGS).most_common(1)
    if len(paths) < FEWEST:
        remedy = f"convert its {other[0][0]} files to JPEG" if other else "photograph all sides"
        raise InputError(f"contains {counted(len(paths), 'JPEG or PNG file')}", folder, "photographs", remedy)
    if more := {*inner} - {*paths}:
        tell(f"not read: {counted(len(more), 'image')} in subfolders, such as {min(more)}")
    if other:
        tell(f"not read: {counted(other[0][1], f'{other[0][0]} file')}; convert them to JPEG")
    read = enumerate(map(_photograph, paths))
    kept = [replace(p, name=str(p.path.relative_to(folder)), number=i) for i, p in read]
    most = Counter(photograph.size for photograph in kept).most_common(1)[0][0]
    kept = [replace(p, lying=p.size != most and p.size[::-1] == most) for p in kept]
    remedy = f"a fit takes {MAX_SIZES} at most: leave out those that were cropped"
    require_few_sizes(folder, "photographs", {p.kept_size: p.name for p in kept}, remedy)
    return kept


def _photograph(path: Path) -> Photograph:
    with open_image(path) as image:
        exif, detail = exif_tags(image)
        size, alpha = image.size, image.has_transparency_data
        plain = image.mode in ("RGB", "L") and not alpha
        cut_out = alpha and image.convert("RGBA").getchannel("A").getextrema()[0] < 255
    said = exif.get(ORIENTATION, 1)
    orientation = int(said) if said in range(1, 9) else 1
    size = size[::-1] if orientation in SIDEWAYS else size
    equivalent, own = positive(detail.get(FOCAL_35MM)), positive(detail.get(FOCAL))
    device = f"{exif.get(MAKE, '')} {exif.get(MODEL, '')} {own or equivalent or ''}"
    focal = None if equivalent is None else equivalent / 43.2666  # mm, diagonal of 36 mm × 24 mm
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    exposure = {tag: detail[tag] for tag in EXIF_EXPOSURE if positive(detail.get(tag)) is not None}
    return Photograph(path, path.name, digest, size, focal, device, exposure, plain, cut_out, orientation)


def find_masks(folder: Path, photographs: Sequence[Photograph]) -> dict[str, Path]:
    """The mask of each photograph by its name, as in `data.images.mask_in`."""
    masks: dict[str, Path] = {}
    if not folder.is_dir():
        raise InputError("no such folder", folder, "--masks", "give one with a PNG file per photograph")
    for photograph in photographs:
        beside = not photograph.cut_out and (folder / photograph.name).resolve() == photograph.path.resolve()
        path, wanted = mask_in(folder, photograph.name, beside), photograph.size
        size = image_header(path)[:2]
        if not is_copy(size, wanted) and not is_copy(size, photograph.stored_size):
            what = f"{size[0]} × {size[1]} pixels, but {photograph.name} has {wanted[0]} × {wanted[1]}"
            raise InputError(what, path, "--masks", "make masks of the photographs' size")
        masks[photograph.name] = path
    return masks


def mask_pixels(path: Path, photograph: Photograph) -> np.ndarray:
    """The mask (H, W, 1) uint8, 255 on the object, of the size and rotation of the photograph."""
    from PIL import Image

    mask = Image.fromarray(to_8_bits(read_mask(path)))
    upright = is_copy(mask.size, photograph.size)
    mask = mask.resize(photograph.size if upright else photograph.stored_size)
    return np.asarray(photograph.turned(mask, 1 if upright else photograph.orientation))[..., None]
