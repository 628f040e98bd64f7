"""Masks of an object: one image per image of the data set, white where the fitted object is seen."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy import ndimage

from mi_refgs.data.images import IMAGES
from mi_refgs.data.lens import GRID, Lens
from mi_refgs.data.view import FileCamera
from mi_refgs.editing.options import Selection
from mi_refgs.editing.selection import select, selected_alpha
from mi_refgs.errors import InputError
from mi_refgs.evaluation.images import image_array
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import make_folder
from mi_refgs.io.images import write_png
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera

STEEPEST = 1e3  # direction over depth of pixels that a pinhole camera does not show
COVERED = 0.5  # opacity of the object from which a pixel is white


def write(
    trained: TrainedScene, target: Path, shots: Sequence[Shot], *, where: str | np.ndarray = ""
) -> list[Path]:
    """Masks of the object in all images of the data set, training and test views, white where it is seen.

    Readers take them from the folder `masks` beside the images: that of `images/a.jpg` is `masks/a.jpg.png`,
    that of `train/r_0.png` is `masks/train/r_0.png.png`. A mask has the size and the lens of its image file.
    There, the opacity of the surfels that `where` selects is at least 0.5; all others occlude them. `where`
    is an expression, or in Python surfels (N,) bool; without it, all but the background are selected.
    """
    if isinstance(where, str):
        if not where and trained.surroundings is None:
            raise InputError("masks: the fit has no background, so all is object; give --where EXPRESSION")
        where = select(trained, Selection(where=where or None))
    written, empty = [], True
    for shot in shots:
        if shot.file is None:
            raise InputError("masks: the data set is unknown or gone; name its folder with --data")
        alpha = image_array(
            selected_alpha(trained, where, shot.camera), shot.camera.height, shot.camera.width
        )
        mask = in_file(alpha, shot.camera, shot.file) >= COVERED
        empty &= not mask.any()
        written.append(target / mask_name(shot.file.path))
        make_folder(written[-1].parent)
        write_png(written[-1], mask)
    if empty:
        raise InputError("masks: no image shows the selected surfels; select others")
    return written


def mask_name(image: Path) -> str:
    """Path of an image's mask below `masks`; that of the image is relative to the data set."""
    parts = image.parts[1:] if len(image.parts) > 1 and image.parts[0].startswith(IMAGES) else image.parts
    return f"{'/'.join(parts)}.png"


def in_file(values: np.ndarray, camera: Camera, file: FileCamera) -> np.ndarray:
    """Resample values (H, W) of a camera's pixels to those of its image file, with the file's lens."""
    x, y = _directions(file.width, file.height, file.intrinsics, file.lens)
    column, row = (  # focal lengths are negative in Mitsuba's frame
        np.float32(centre[0] - 0.5) - np.float32(focal[0]) * slope
        for centre, focal, slope in ((camera.cx, camera.fx, x), (camera.cy, camera.fy, y))
    )
    return np.asarray(ndimage.map_coordinates(values, (row, column), order=1, mode="nearest"))


@lru_cache(maxsize=2)
def _directions(
    width: int, height: int, intrinsics: tuple[float, float, float, float], lens: Lens | None
) -> np.ndarray:
    """Direction over depth, x to the right and y down, (2, H, W) float32, that each pixel of a file shows."""
    fx, fy, cx, cy = intrinsics
    columns, rows = np.linspace(0, width - 1, GRID), np.linspace(0, height - 1, GRID)
    x, y = np.meshgrid((columns + 0.5 - cx) / fx, (rows + 0.5 - cy) / fy)
    if lens is not None:
        x, y = (np.clip(np.nan_to_num(slope), -STEEPEST, STEEPEST) for slope in lens.undistort(x, y))
    fine = np.meshgrid(
        *(np.linspace(0, GRID - 1, n, dtype=np.float32) for n in (height, width)), indexing="ij"
    )
    return np.stack([ndimage.map_coordinates(c.astype(np.float32), fine, order=1) for c in (x, y)])
