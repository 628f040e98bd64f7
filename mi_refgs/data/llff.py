"""LLFF's layout: `poses_bounds.npy` beside `images`, smaller copies in `images_2` and the like, and `masks`.

A row a picture, in the order of their names: a 3 × 5 matrix by rows, then the nearest and the farthest depth.
The matrix holds the camera's axes in the world (down, right, backwards), its position, and height, width and
focal length in pixels. Every eighth picture is a test view. [Mildenhall et al., Local Light Field Fusion,
SIGGRAPH 2019]
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.picture_files import Mask, PictureFile, make_view
from mi_refgs.data.picture_folders import PictureFolders, mask_file, mask_folder
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.readers import ReadOptions, Recording, held_out
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

POSES = "poses_bounds.npy"
COLUMNS = 17


class LlffReader:
    """Reads folders with `poses_bounds.npy`."""

    name = "LLFF"
    looks_for = "poses_bounds.npy, beside images"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder holds the poses."""
        return (folder / POSES).is_file()

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training picture as it lies in its file."""
        picture = _placed(folder, "train", ReadOptions(images=images))[0][2]
        return picture.width, picture.height

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """The views of one split."""
        views = tuple(_view(folder / POSES, options, *placed) for placed in _placed(folder, split, options))
        return Recording(views, source=folder / POSES)


def _placed(folder: Path, split: str, options: ReadOptions) -> list[tuple[str, np.ndarray, PictureFile]]:
    """Name, row and picture of each picture of a split."""
    if options.images != "png":
        raise InputError(f"{folder}: images: LLFF has no EXR pictures; read it as 'png'")
    rows, pictures = read_poses(folder / POSES), PictureFolders.of(folder)
    names = pictures.names()
    if len(names) != len(rows):
        raise InputError(
            f"{folder / POSES}: {len(rows)} cameras, but {pictures.folders[1].name} has {len(names)} "
            "pictures; restore the pictures"
        )
    placed, masks = [], mask_folder(folder)
    for name, row in held_out(list(zip(names, rows, strict=True)), split):
        found = pictures.find(name, options.downscale, whole=masks is not None)
        file, left = found or (pictures.folders[1] / name, options.downscale)
        mask = None if masks is None else Mask(mask_file(masks, name))
        placed.append((name, row, PictureFile.find(file, left, mask)))
    if not placed:
        raise InputError(f"{folder / POSES}: zero {split} views; add pictures")
    return placed


def read_poses(path: Path) -> np.ndarray:
    """The (N, 17) float64 table; raises InputError for a file that cannot be used."""
    try:
        # Mapped, so that a promise of more numbers than the file has is refused, not kept. `np.load` would
        # also take archives and pickles.
        table = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # NumPy raises half a dozen types for broken headers
        raise InputError(
            f"{path}: NumPy: cannot be read ({str(error)[:100]}); copy the file again"
        ) from error
    if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table) or table.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: has shape {table.shape}, not N × {COLUMNS} numbers; export the poses again"
        )
    rows = np.array(table, dtype=np.float64)
    if not (np.abs(rows) <= MAX_NUMBER).all():
        raise InputError(f"{path}: some numbers are infinite or no numbers; export the poses again")
    return rows


def _view(source: Path, options: ReadOptions, name: str, row: np.ndarray, picture: PictureFile) -> View:
    matrix, field = row[:15].reshape(3, 5), f"{source}: {name}"
    down, right, backwards, position, (height, width, focal) = matrix.T
    if min(height, width, focal) <= 0:
        raise InputError(f"{field}: height, width and focal length are not positive; export the poses again")
    pose = np.eye(4)
    pose[:3] = np.stack([right, -down, backwards, position], axis=-1)
    to_world = rigid(pose, field) @ MITSUBA_FROM_OPENGL
    fx, fy = focal * picture.width / width, focal * picture.height / height
    intrinsics = (fx, fy, picture.width / 2, picture.height / 2)
    return make_view(name, picture, options, intrinsics, None, to_world, field)[0]
