"""Reader of NeRO's Glossy Synthetic: `i.png`, 16-bit depth `i-depth.png` of 15 units along the viewing axis
(nearer than 14.5: the object), and `i-camera.pkl`, a pickled list of the pose (3 × 4, world to camera,
OpenCV's axes) and K (3 × 3). Every eighth image by number is a test view. [Liu et al., SIGGRAPH 2023]"""

import pickletools
import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.dataset import ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, Mask, block_mean
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.images import read_grey

CAMERA = re.compile(r"(\d{1,6})-camera\.pkl")
SHAPES = ((3, 4), (3, 3))  # of pose and K
MAX_DEPTH, MAX_CODE = 15.0, 65535  # scene units of the largest number in a depth file, and that number
BACKGROUND = int(14.5 / MAX_DEPTH * MAX_CODE) + 1  # smallest number of the background: 14.5 units


class GlossyReader:
    """Reads folders with `0-camera.pkl` and so on."""

    name = "NeRO Glossy Synthetic"
    looks_for = "0-camera.pkl, beside 0.png and 0-depth.png"

    def recognises(self, folder: Path) -> bool:
        return bool(_numbers(folder))

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        numbers = held_out(_numbers(folder), split, folder)
        return Recording(tuple(_view(folder, number, options) for number in numbers), source=folder)


def _numbers(folder: Path) -> list[int]:
    found = (CAMERA.fullmatch(path.name) for path in folder.glob("*-camera.pkl"))
    return sorted({int(match[1]) for match in found if match})


def _view(folder: Path, number: int, options: ReadOptions) -> View:
    file, depths = folder / f"{number}-camera.pkl", folder / f"{number}-depth.png"
    pose, matrix = _arrays(file)
    expected = np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1]])
    if not (np.abs(matrix) <= MAX_NUMBER).all() or (matrix != expected).any() or min(np.diag(matrix)) <= 0:
        raise InputError("no matrix of focal lengths and a principal point", file, "K", "copy the file again")
    to_world = from_world_to_camera(pose[:, :3], pose[:, 3], f"{file}: pose")
    image = ImageFile.of(folder / f"{number}.png", options.downscale, Mask(depths, BACKGROUND))
    size, pinhole = (image.width, image.height), (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    view, _ = make_view(image, options, str(file), str(number), size, pinhole, to_world)
    if not options.truth:
        return view
    grey = read_grey(depths)[0][..., None]
    depth = grey.astype(np.float32) * np.float32(MAX_DEPTH / MAX_CODE)
    return replace(view, depth=block_mean(depth, grey < BACKGROUND, options.downscale)[0][..., 0])


def _arrays(path: Path) -> list[np.ndarray]:
    """The arrays of SHAPES in a pickle, a program that is not run: its instructions are searched for them."""
    arrays, code, by_columns, sides = list[np.ndarray](), "", False, list[int]()
    try:
        with path.open("rb") as file:
            data = file.read(4096)  # it has a few hundred bytes
        for instruction, value, _ in pickletools.genops(data):
            if isinstance(value, bool) or instruction.name in ("NEWTRUE", "NEWFALSE"):
                by_columns = value or instruction.name == "NEWTRUE"
            elif "INT" in instruction.name:
                sides.append(int(value or 0))
            elif value in ("f4", "f8"):  # of this array, and of later ones that refer to it
                code = f"<{value}"
            elif value == ">":
                raise ValueError("big-endian numbers")
            elif isinstance(value, bytes | str) and len(value) > 1 and instruction.name != "GLOBAL":
                numbers = value if isinstance(value, bytes) else value.encode("latin1")
                if len(arrays) < 2 and len(numbers) == np.prod(SHAPES[len(arrays)]) * int(code[-1:] or 0):
                    found = np.frombuffer(numbers, code).astype(np.float64)
                    arrays.append(found.reshape(sides[2:4], order="F" if by_columns else "C"))
                    sides = []
        if [array.shape for array in arrays] != [*SHAPES]:
            raise ValueError("no pose of 3 × 4 and matrix of 3 × 3 numbers")
    except Exception as error:  # what a broken file raises has no common type
        raise InputError(str(error)[:100], path, "pickle", "copy the file again") from error
    return arrays
