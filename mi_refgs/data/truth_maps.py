"""Ground-truth maps at a view's size, and the maps that lie beside the pictures of Shiny Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.data.lens import Undistortion
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file
from mi_refgs.io.images import box_downscale, read_png, read_tiff

NORMALS, DISPARITY, ALPHA = "_normal.png", "_disp.tiff", "_alpha.png"
"""What follows a picture's name, without its ending, in the names of its maps."""
DIRECTED = 0.5
"""Length from which a normal of 8 bits is one: none is stored as (½, ½, ½)."""


def block_mean(
    pixels: np.ndarray, covered: np.ndarray, downscale: int, straight: Undistortion | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean (h, w, C) over what is covered in each block of a map (H, W, C), and the covered share (h, w, 1).

    `covered` (H, W, 1) is 0 … 1. The mean is 0 where nothing is covered.
    """
    covered = covered.astype(np.float32)
    share, total = box_downscale(covered, downscale), box_downscale(pixels * covered, downscale)
    if straight is not None:  # linear, so that no weight is negative
        share, total = straight.resample(share, order=1), straight.resample(total, order=1)
    return np.where(share > 0, total / np.maximum(share, 1e-12), 0).astype(np.float32), share


def unit(normal: np.ndarray) -> np.ndarray:
    """Normals (H, W, 3) of length 1; zeros stay."""
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > 0, normal / np.maximum(length, 1e-12), 0).astype(np.float32)


def beside(picture: Path, ending: str) -> Path | None:
    """The map of a picture whose name has this ending; None without one."""
    file = picture.with_name(picture.stem + ending)
    return file if is_file(file) else None


def shiny_maps(
    picture: Path, shape: tuple[int, int], downscale: int, straight: Undistortion | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """World normals (h, w, 3) and depths (h, w) of a picture of Shiny Blender, None where there are none.

    Normals n are stored as (n + 1) / 2 in 8 bits, depths z along the viewing axis as 1 / (1 + z), and 0 where
    there is nothing [Ref-NeRF, Verbin et al. 2022]. `shape` is that of the picture. Raises InputError for a
    map of another one.
    """
    normal = depth = None
    if file := beside(picture, NORMALS):
        pixels = 2 * _of_shape(file, read_png(file)[..., :3], shape) - 1
        directed = np.linalg.norm(pixels, axis=-1, keepdims=True) > DIRECTED
        normal = unit(block_mean(pixels, directed, downscale, straight)[0])
    if file := beside(picture, DISPARITY):
        disparity = _of_shape(file, read_tiff(file), shape)[..., None]
        covered = (disparity > 0) & (disparity < 1)
        depths = np.where(covered, 1 / np.where(covered, disparity, 1) - 1, 0).astype(np.float32)
        depth = block_mean(depths, covered, downscale, straight)[0][..., 0]
    return normal, depth


def _of_shape(file: Path, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if pixels.shape[:2] != shape:
        raise InputError(
            f"{file}: size: {pixels.shape[1]} × {pixels.shape[0]} pixels, but the picture has {shape[1]} × "
            f"{shape[0]}; restore the map, or remove it"
        )
    return pixels
