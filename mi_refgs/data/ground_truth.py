"""Ground-truth maps at a view's size, and the maps beside the images of Shiny Blender."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.data.lens import Undistortion
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file
from mi_refgs.io.images import box_downscale, read_png, read_tiff

NORMALS, DISPARITY, ALPHA = "_normal.png", "_disp.tiff", "_alpha.png"  # after the stem of an image's name
NORMAL_LENGTH = 0.5  # smallest length of an 8-bit normal: no normal is stored as (½, ½, ½)


def block_mean(
    pixels: np.ndarray,  # (H, W, C)
    covered: np.ndarray,  # (H, W, 1), 0 … 1
    downscale: int,
    straight: Undistortion | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean over what is covered in each block, (h, w, C), 0 without coverage; covered fraction (h, w, 1)."""
    covered = covered.astype(np.float32)
    fraction, total = box_downscale(covered, downscale), box_downscale(pixels * covered, downscale)
    if straight is not None:  # linear interpolation, so that no weight is negative
        fraction, total = straight.resample(fraction, order=1), straight.resample(total, order=1)
    return np.where(fraction > 0, total / np.maximum(fraction, 1e-12), 0).astype(np.float32), fraction


def unit(normal: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.where(length > 0, normal / np.maximum(length, 1e-12), 0).astype(np.float32)


def beside(image: Path, ending: str) -> Path | None:
    """The map of an image whose name has this ending; None without one."""
    file = image.with_name(image.stem + ending)
    return file if is_file(file) else None


def shiny_blender_maps(
    image: Path,
    shape: tuple[int, int],  # of the image file
    downscale: int,
    straight: Undistortion | None,
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """World normals (h, w, 3) and depths (h, w) beside an image of Shiny Blender, each None without a file.

    Normals n are stored as (n + 1) / 2 in 8 bits; depths z along the viewing axis as 1 / (1 + z), and 0 off
    the object. [Ref-NeRF, Verbin et al. 2022]
    """
    normal = depth = None
    if file := beside(image, NORMALS):
        pixels = 2 * _of_shape(file, read_png(file)[..., :3], shape) - 1
        stored = np.linalg.norm(pixels, axis=-1, keepdims=True) > NORMAL_LENGTH
        normal = unit(block_mean(pixels, stored, downscale, straight)[0])
    if file := beside(image, DISPARITY):
        disparity = _of_shape(file, read_tiff(file), shape)[..., None]
        covered = (disparity > 0) & (disparity < 1)
        depths = np.where(covered, 1 / np.where(covered, disparity, 1) - 1, 0).astype(np.float32)
        depth = block_mean(depths, covered, downscale, straight)[0][..., 0]
    return normal, depth


def _of_shape(file: Path, pixels: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    if pixels.shape[:2] != shape:
        what = f"{pixels.shape[1]} × {pixels.shape[0]} pixels, but the image has {shape[1]} × {shape[0]}"
        raise InputError(what, file, "size", "restore the map, or remove it")
    return pixels
