"""Reader of LLFF's layout: `poses_bounds.npy` beside `images`, smaller copies in `images_2` …, and `masks`.

One row per image, in the order of their names: a 3 × 5 matrix by rows, then the nearest and the farthest
depth. The columns of the matrix are the camera's axes in the world (down, right, backwards), its position,
and height, width and focal length in pixels. Every eighth image is a test view. [Mildenhall et al., Local
Light Field Fusion, SIGGRAPH 2019]
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.dataset import ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, ImageFolders
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

POSES = "poses_bounds.npy"
COLUMNS = 17


class LlffReader:
    """Reads folders with `poses_bounds.npy`."""

    name = "LLFF"
    looks_for = "poses_bounds.npy, beside images"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder contains the poses."""
        return (folder / POSES).is_file()

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training image in its file."""
        image = _images(folder, "train", ReadOptions(images=images))[0][2]
        return image.width, image.height

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """Read the views of one split."""
        views = tuple(_view(folder / POSES, options, *image) for image in _images(folder, split, options))
        return Recording(views, source=folder / POSES)


def _images(folder: Path, split: str, options: ReadOptions) -> list[tuple[str, np.ndarray, ImageFile]]:
    """Name, row and file of each image of a split."""
    if options.images != "png":
        raise InputError(f"{folder}: images: LLFF has no EXR images; read it as 'png'")
    rows, folders = read_poses(folder / POSES), ImageFolders.of(folder)
    names = folders.names()
    if len(names) != len(rows):
        raise InputError(
            f"{folder / POSES}: {len(rows)} cameras, but {folders.folders[1].name} has {len(names)} images; "
            "restore the images"
        )
    images = []
    for name, row in held_out(list(zip(names, rows, strict=True)), split, folder / POSES):
        file, left = folders.find(name, options.downscale) or (folders.folders[1] / name, options.downscale)
        images.append((name, row, ImageFile.of(file, left, folders.mask(name))))
    return images


def read_poses(path: Path) -> np.ndarray:
    """The (N, 17) float64 table; raises InputError for a file that cannot be used."""
    try:
        # A memory map refuses a header that promises more numbers than the file has; `np.load` would
        # also open archives and pickles.
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
        raise InputError(f"{path}: some numbers are infinite or NaN; export the poses again")
    return rows


def _view(source: Path, options: ReadOptions, name: str, row: np.ndarray, image: ImageFile) -> View:
    matrix, field = row[:15].reshape(3, 5), f"{source}: {name}"
    down, right, backwards, position, (height, width, focal) = matrix.T
    if min(height, width, focal) <= 0:
        raise InputError(f"{field}: height, width and focal length are not positive; export the poses again")
    pose = np.eye(4)
    pose[:3] = np.stack([right, -down, backwards, position], axis=-1)
    to_world = rigid(pose, field) @ MITSUBA_FROM_OPENGL
    fx, fy = focal * image.width / width, focal * image.height / height
    intrinsics = (fx, fy, image.width / 2, image.height / 2)
    return make_view(image, options, field, name=name, intrinsics=intrinsics, to_world=to_world)[0]
