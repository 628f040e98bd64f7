"""The data set of a capture: pictures and masks without their lens, and COLMAP's files of pinhole cameras."""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap
from mi_refgs.capture.frame import Similarity
from mi_refgs.capture.masks import mask_pixels
from mi_refgs.capture.photographs import Photograph
from mi_refgs.data.colmap_model import MODELS, Camera
from mi_refgs.data.lens import Undistortion, undistortion
from mi_refgs.errors import InputError
from mi_refgs.io.files import replace_file

QUALITY = 95
"""Quality of JPEG files; with a lower one, a fit learns the edges of their blocks."""
WRITERS = 4
"""Largest number of pictures that are straightened at once. Peak memory of the process, measured with
pictures of 12 Mpx of one lens: 0.5 GB with one at once, 1.3 GB with four."""
SPLINE_PIXELS = 2_000_000
"""Pixels up to which pictures are resampled with cubic splines; larger ones are reduced before a fit sees
them."""


@dataclass(frozen=True)
class Straight:
    """The pinhole camera of a group of pictures, and how their lens is undone."""

    size: tuple[int, int]  # pixels, as the photographs lie
    focal: tuple[float, float]  # pixels
    centre: tuple[float, float]
    undo: Undistortion | None  # None where there is no distortion: pictures stay as they are

    @classmethod
    def of(cls, camera: Any, size: tuple[int, int]) -> Straight:
        """The camera for pictures of `size`, from a pycolmap.Camera of the working copies.

        Raises InputError where the lens cannot be undone.
        """
        values = dict(zip(MODELS[camera.model_name][1].split(), camera.params, strict=True))
        known = Camera(camera.model_name, camera.width, camera.height, values)
        fx, fy, cx, cy = np.array(known.intrinsics) * np.tile(
            np.divide(size, (camera.width, camera.height)), 2
        )
        try:
            lens = known.lens()
            undo = None if lens is None else undistortion(lens, *size, fx, fy, cx, cy)
        except InputError as error:
            raise InputError(
                f"photographs: the lens found cannot be undone ({error}); choose another lens model, such as "
                "--camera RADIAL"
            ) from None
        zoom = 1.0 if undo is None else undo.zoom
        return cls(size, (zoom * fx, zoom * fy), (cx, cy), undo)

    def resample(self, pixels: np.ndarray) -> np.ndarray:
        """An (H, W, C) uint8 picture without the lens."""
        if self.undo is None:
            return pixels
        order = 3 if pixels.shape[0] * pixels.shape[1] <= SPLINE_PIXELS else 1
        result = np.empty_like(pixels)
        for i in range(pixels.shape[2]):  # one channel at a time, for less memory
            plane = pixels[..., i : i + 1].astype(np.float32)
            result[..., i : i + 1] = np.rint(self.undo.resample(plane, order=order))
        return result


def straighten(model: Any, photographs: dict[str, Photograph]) -> dict[str, Straight]:
    """How the lens of each placed picture is undone, by the name of its working copy."""
    sizes: dict[int, tuple[int, int]] = {}
    images = [model.images[i] for i in model.reg_image_ids()]
    for image in images:
        sizes[image.camera_id] = photographs[image.name].kept_size
    straight = {i: Straight.of(model.cameras[i], size) for i, size in sizes.items()}
    return {image.name: straight[image.camera_id] for image in images}


def write_pictures(
    placed: Sequence[Photograph],
    straight: Callable[[Photograph], Straight],
    masks: dict[str, Path],
    folder: Path,
    progress: Callable[[Sequence[Photograph]], Iterable[Photograph]],
) -> None:
    """images/NAME, and masks/NAME.png where there are masks, those that are not there yet."""
    for part in ("images", *(["masks"] if masks else [])):
        (folder / part).mkdir(parents=True, exist_ok=True)

    def write(photograph: Photograph) -> None:
        from PIL import Image

        camera, picture = straight(photograph), folder / "images" / photograph.name
        if not picture.is_file():
            if camera.undo is None and photograph.as_displayed:
                replace_file(picture, partial(shutil.copyfile, photograph.path))
            else:
                pixels = Image.fromarray(camera.resample(np.asarray(photograph.load())))
                replace_file(picture, partial(_save, pixels, photograph))
        if masks:
            mask = folder / "masks" / f"{photograph.name}.png"
            pixels = Image.fromarray(camera.resample(mask_pixels(masks[photograph.name], photograph))[..., 0])
            replace_file(mask, lambda path: pixels.save(path, format="PNG"))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, WRITERS)) as pool:
        for written, _ in zip(pool.map(write, placed), progress(placed), strict=True):
            assert written is None


def _save(picture: Any, photograph: Photograph, path: Path) -> None:
    jpeg = photograph.path.suffix.lower() in (".jpg", ".jpeg")
    options = {"format": "JPEG", "quality": QUALITY, "subsampling": 0} if jpeg else {"format": "PNG"}
    picture.save(path, exif=photograph.exif(), **options)


def write_model(
    model: Any,
    photographs: dict[str, Photograph],
    straight: dict[str, Straight],
    similarity: Similarity,
    folder: Path,
) -> None:
    """COLMAP's binary files of the moved, straightened reconstruction."""
    pycolmap = colmap.load()
    moved = pycolmap.Reconstruction(model)
    pose = pycolmap.Sim3d(similarity.scale, pycolmap.Rotation3d(similarity.rotation), similarity.translation)
    moved.transform(pose)
    lenses = {i: copy.deepcopy(camera) for i, camera in moved.cameras.items()}
    for i in moved.reg_image_ids():
        image = moved.images[i]
        camera, lens = straight[image.name], lenses[image.camera_id]
        rays = lens.cam_from_img(np.array([point.xy for point in image.points2D]).reshape(-1, 2))
        for point, ray in zip(image.points2D, np.asarray(rays, dtype=np.float64), strict=True):
            seen = ray * camera.focal + camera.centre
            point.xy = np.where(np.isfinite(seen), seen, 0)
        own = moved.cameras[image.camera_id]
        own.model, own.width, own.height = pycolmap.CameraModelId.PINHOLE, *camera.size
        own.params = [*camera.focal, *camera.centre]
        image.name = photographs[image.name].name
    folder.mkdir(parents=True, exist_ok=True)
    moved.write_binary(folder)
