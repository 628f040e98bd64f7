"""Reader of LLFF's layout: `poses_bounds.npy` beside `images`, or copies such as `images_4`, and `masks`.

One row per image by name: a 3 × 5 matrix by rows, nearest and farthest depth. Its columns are the camera's
axes in the world (down, right, backwards), its position, and height, width and focal length in pixels. Every
eighth image is a test view. [Mildenhall et al., Local Light Field Fusion, SIGGRAPH 2019]"""

from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.dataset import ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, image_files, image_folder, mask_of
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.view import View
from mi_refgs.errors import InputError

POSES, COLUMNS = "poses_bounds.npy", 17


class LlffReader:
    """Reads folders with `poses_bounds.npy`."""

    name = "LLFF"
    looks_for = "poses_bounds.npy, beside images"

    def recognises(self, folder: Path) -> bool:
        return (folder / POSES).is_file()

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        source, images = folder / POSES, image_folder(folder, folder)[0]
        rows, files = read_poses(source), image_files(images, deep=images != folder)
        if len(files) != len(rows):
            what = f"{len(rows)} cameras, but {images.name} has {len(files)} images"
            raise InputError(what, source, remedy="restore the images")
        chosen = held_out(list(zip(files, rows, strict=True)), split, source)
        return Recording(tuple(_view(source, images, options, *one) for one in chosen), source=source)


def read_poses(path: Path) -> np.ndarray:
    """The (N, 17) float64 table; raises InputError for a file that cannot be used."""
    try:
        # Unlike `np.load`, it opens no pickle, and refuses a header that promises more than the file has.
        table = np.lib.format.open_memmap(path, mode="r")
    except Exception as error:  # NumPy raises half a dozen types for broken headers
        what = f"cannot be read ({str(error)[:100]})"
        raise InputError(what, path, "NumPy", "copy the file again") from error
    if table.ndim != 2 or table.shape[1] != COLUMNS or not len(table) or table.dtype.kind not in "fiu":
        what = f"has shape {table.shape}, not N × {COLUMNS} numbers"
        raise InputError(what, path, remedy="export the poses again")
    rows = np.array(table, dtype=np.float64)
    if not (np.abs(rows) <= MAX_NUMBER).all():
        raise InputError("some numbers are infinite or NaN", path, remedy="export the poses again")
    return rows


def _view(source: Path, images: Path, options: ReadOptions, path: Path, row: np.ndarray) -> View:
    image = ImageFile.of(path, options.downscale, mask_of(path, source.parent))
    name = path.relative_to(images).as_posix()
    down, right, backwards, position, (height, width, focal) = row[:15].reshape(3, 5).T
    if min(height, width, focal) <= 0:
        remedy = "export the poses again"
        raise InputError("height, width and focal length are not positive", source, name, remedy)
    pose = np.eye(4)
    pose[:3] = np.stack([right, -down, backwards, position], axis=-1)
    to_world = rigid(pose, f"{source}: {name}") @ MITSUBA_FROM_OPENGL
    size, pinhole = (width, height), (focal, focal, width / 2, height / 2)
    return make_view(image, options, f"{source}: {name}", name, size, pinhole, to_world)[0]
