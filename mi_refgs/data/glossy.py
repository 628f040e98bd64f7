"""Reader of NeRO's Glossy Synthetic: per image an `i.png`, its depth `i-depth.png` and camera `i-camera.pkl`.

A camera is a pickled list of the pose (3 × 4, world to camera, OpenCV's axes) and the 3 × 3 matrix K. Depths
along the viewing axis have 16 bits for 15 units; what is nearer than 14.5 is the object. Every eighth image
by number is a test view, as in the splits made for 3DGS-DR and Ref-Gaussian. [NeRO, Liu et al., SIGGRAPH
2023]
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.array_pickle import read_arrays
from mi_refgs.data.dataset import ReadOptions, Recording, held_out, make_view
from mi_refgs.data.ground_truth import block_mean
from mi_refgs.data.images import ImageFile, Mask
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.images import image_size, read_grey

CAMERA = re.compile(r"(\d{1,6})-camera\.pkl")
MAX_DEPTH, MAX_CODE = 15.0, 65535  # scene units of the largest number in a depth file, and that number
BACKGROUND = int(14.5 / MAX_DEPTH * MAX_CODE) + 1  # smallest number of the background: 14.5 units


class GlossyReader:
    """Reads folders with `0-camera.pkl` and so on."""

    name = "NeRO Glossy Synthetic"
    looks_for = "0-camera.pkl, beside 0.png and 0-depth.png"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder contains cameras."""
        return any(CAMERA.fullmatch(path.name) for path in folder.glob("*-camera.pkl"))

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training image in its file."""
        return image_size(folder / f"{_numbers(folder, 'train')[0]}.png")

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """Read the views of one split, with depths."""
        if options.images != "png":
            raise InputError(f"{folder}: images: the layout has no EXR images; read it as 'png'")
        views = tuple(_view(folder, number, options) for number in _numbers(folder, split))
        return Recording(views, source=folder)


def _numbers(folder: Path, split: str) -> list[int]:
    found = (CAMERA.fullmatch(path.name) for path in folder.glob("*-camera.pkl"))
    return held_out(sorted({int(match[1]) for match in found if match}), split, folder)


def _view(folder: Path, number: int, options: ReadOptions) -> View:
    field, depths = folder / f"{number}-camera.pkl", folder / f"{number}-depth.png"
    pose, matrix = _camera(field)
    to_world = from_world_to_camera(pose[:, :3], pose[:, 3], f"{field}: pose")
    image = ImageFile.of(folder / f"{number}.png", options.downscale, Mask(depths, BACKGROUND))
    pinhole = (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    view, _ = make_view(image, options, str(field), name=str(number), intrinsics=pinhole, to_world=to_world)
    if not options.truth:
        return view
    grey = read_grey(depths)[0][..., None]
    depth = grey.astype(np.float32) * np.float32(MAX_DEPTH / MAX_CODE)
    return replace(view, depth=block_mean(depth, grey < BACKGROUND, options.downscale)[0][..., 0])


def _camera(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Pose (3, 4) and K (3, 3); raises InputError for anything else."""
    arrays = read_arrays(path)
    if [array.shape for array in arrays] != [(3, 4), (3, 3)]:
        raise InputError(f"{path}: not a pose of 3 × 4 and a matrix of 3 × 3 numbers; copy the file again")
    pose, matrix = arrays
    expected = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if not (np.abs(matrix) <= MAX_NUMBER).all() or (matrix != expected).any() or min(np.diag(matrix)) <= 0:
        raise InputError(f"{path}: K: no matrix of focal lengths and a principal point; copy the file again")
    return pose, matrix
