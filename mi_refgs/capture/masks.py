"""Masks made elsewhere: white where the object is, one picture for each photograph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs.capture.photographs import Photograph
from mi_refgs.errors import InputError
from mi_refgs.io.images import ENDINGS, open_image, read_mask, to_8_bits


def find_masks(folder: Path | None, photographs: Sequence[Photograph]) -> dict[str, Path]:
    """The mask of each photograph by the photograph's name; none without a folder.

    PHOTO.jpg's is PHOTO.png, PHOTO.jpg.png or PHOTO.jpg, of the photograph's size as stored or as displayed.
    Raises InputError for a photograph without a mask and for a mask of another size.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise InputError(f"{folder}: --masks: no such folder; give one with a PNG file for each photograph")
    there = {path.name.lower(): path for path in sorted(folder.iterdir()) if path.is_file()}
    masks: dict[str, Path] = {}
    for photograph in photographs:
        name, stem = photograph.name.lower(), photograph.path.stem.lower()
        candidates = [name + ".png", *(stem + ending for ending in ENDINGS)]
        path = next((there[candidate] for candidate in candidates if candidate in there), None)
        if path is None:
            raise InputError(
                f"{folder}: --masks: none for {photograph.name}; add {photograph.path.stem}.png, white where "
                "the object is"
            )
        with open_image(path) as picture:
            size = picture.size
        if size not in (photograph.size, photograph.stored_size):
            raise InputError(
                f"{path}: --masks: {size[0]} × {size[1]} pixels, but {photograph.name} has "
                f"{photograph.size[0]} × {photograph.size[1]}; make masks of the photographs' size"
            )
        masks[photograph.name] = path
    return masks


def mask_pixels(path: Path, photograph: Photograph) -> np.ndarray:
    """The mask as the photograph lies in the data set, (H, W, 1) uint8, 255 on the object.

    A mask of the stored size is turned as the photograph is, unless that is the displayed size, too. Raises
    InputError as `read_mask` does.
    """
    from PIL import Image

    mask = Image.fromarray(to_8_bits(read_mask(path)))
    displayed = mask.size == photograph.size
    turned = (replace(photograph, orientation=1) if displayed else photograph).turned(mask)
    return np.asarray(turned)[..., None]
