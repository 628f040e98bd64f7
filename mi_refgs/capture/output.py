"""The data set of a capture: undistorted images and masks, COLMAP's files of pinhole cameras, and its folder.

The file RECORD lists the files that the last capture wrote, so that the next one removes no others, and marks
the folder as one to which a capture may write.
"""

from __future__ import annotations

import copy
import os
import shutil
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap
from mi_refgs.capture.frame import Similarity
from mi_refgs.capture.photographs import Photograph, mask_pixels
from mi_refgs.data.colmap_model import MODELS, Camera
from mi_refgs.data.lens import Undistortion, undistortion
from mi_refgs.errors import InputError
from mi_refgs.io.files import (
    TEMPORARY,
    cannot_write,
    inside,
    is_file,
    read_json,
    remove_temporaries,
    replace_file,
    write_json,
)
from mi_refgs.progress import with_bar

QUALITY = 95  # quality of JPEG files; lower ones make a fit reproduce their block edges
WRITERS = 4
"""Largest number of images that are undistorted at once. Peak memory of the process, measured with images of
12 Mpx of one lens: 0.5 GB with one, 1.3 GB with four."""
SPLINE_PIXELS = 2_000_000
"""Pixels up to which images are resampled with cubic splines; larger ones are reduced before a fit sees
them."""
WORK = ".work"  # folder of working copies, features, matches and models; it may be removed after the capture
RECORD = ".capture.json"  # key and names of the files of the last output
LAST = "sparse/0/images.bin"
"""The file that is removed first and moved last: without it the folder is no data set."""


@dataclass(frozen=True)
class Straight:
    """The pinhole camera of a group of images, and their undistortion."""

    size: tuple[int, int]  # pixels, oriented as in the data set
    focal: tuple[float, float]  # pixels
    centre: tuple[float, float]
    undo: Undistortion | None  # None without distortion: images are unchanged

    @classmethod
    def of(cls, camera: Any, size: tuple[int, int]) -> Straight:
        """The camera for images of `size`, from a pycolmap.Camera of the working copies.

        Raises InputError if the lens cannot be undone.
        """
        values = dict(zip(MODELS[camera.model_name][1].split(), camera.params, strict=True))
        known = Camera(camera.model_name, camera.width, camera.height, values)
        scale = np.divide(size, (camera.width, camera.height))
        fx, fy, cx, cy = np.array(known.intrinsics) * np.tile(scale, 2)
        try:
            lens = known.lens()
            undo = None if lens is None else undistortion(lens, *size, fx, fy, cx, cy)
        except InputError as error:
            raise InputError(
                f"photographs: the lens found cannot be undone ({error}); choose another lens model, such as "
                "--camera-model RADIAL"
            ) from None
        zoom = 1.0 if undo is None else undo.zoom
        return cls(size, (zoom * fx, zoom * fy), (cx, cy), undo)

    def resample(self, pixels: np.ndarray) -> np.ndarray:
        """Undistort an (H, W, C) uint8 image."""
        if self.undo is None:
            return pixels
        order = 3 if pixels.shape[0] * pixels.shape[1] <= SPLINE_PIXELS else 1
        result = np.empty_like(pixels)
        for i in range(pixels.shape[2]):  # per channel, for less memory
            plane = pixels[..., i : i + 1].astype(np.float32)
            result[..., i : i + 1] = np.rint(self.undo.resample(plane, order=order))
        return result


def straighten(model: Any, photographs: dict[str, Photograph]) -> dict[str, Straight]:
    """The undistortion of each registered image by the name of its working copy."""
    images = [model.images[i] for i in model.reg_image_ids()]
    sizes = {image.camera_id: photographs[image.name].kept_size for image in images}
    straight = {i: Straight.of(model.cameras[i], size) for i, size in sizes.items()}
    return {image.name: straight[image.camera_id] for image in images}


def write_images(
    placed: Sequence[Photograph],
    straight: Callable[[Photograph], Straight],
    masks: dict[str, Path],
    folder: Path,
) -> None:
    """Write missing images/NAME, and masks/NAME.png if there are masks."""
    for part in ("images", *(["masks"] if masks else [])):
        (folder / part).mkdir(parents=True, exist_ok=True)

    def write(photograph: Photograph) -> None:
        from PIL import Image

        camera, image = straight(photograph), folder / "images" / photograph.name
        if not image.is_file():
            if camera.undo is None and photograph.as_displayed:
                replace_file(image, partial(shutil.copyfile, photograph.path))
            else:
                pixels = Image.fromarray(camera.resample(np.asarray(photograph.load())))
                replace_file(image, partial(_save, pixels, photograph))
        if masks:
            mask = folder / "masks" / f"{photograph.name}.png"
            pixels = Image.fromarray(camera.resample(mask_pixels(masks[photograph.name], photograph))[..., 0])
            replace_file(mask, lambda path: pixels.save(path, format="PNG"))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, WRITERS)) as pool:
        for written, _ in zip(pool.map(write, placed), with_bar(placed, "undistorted"), strict=True):
            assert written is None


def _save(image: Any, photograph: Photograph, path: Path) -> None:
    jpeg = photograph.path.suffix.lower() in (".jpg", ".jpeg")
    options = {"format": "JPEG", "quality": QUALITY, "subsampling": 0} if jpeg else {"format": "PNG"}
    image.save(path, exif=photograph.exif(), **options)


def write_model(
    model: Any,
    photographs: dict[str, Photograph],
    straight: dict[str, Straight],
    similarity: Similarity,
    folder: Path,
) -> None:
    """Write COLMAP's binary files of the transformed, undistorted reconstruction."""
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


def prepare(folder: Path, sources: Sequence[Path]) -> None:
    """Make or accept the folder of a data set; `sources` are the folders that are read.

    Raises InputError for a folder that is or contains a source, that contains anything but a capture, and
    that cannot be written.
    """
    real = folder.resolve()
    for source in sources:
        if real in (source.resolve(), *source.resolve().parents):
            raise InputError(f"{folder}: output: it contains {source}, which is read; choose another folder")
    try:
        empty = not folder.is_dir() or not any(folder.iterdir())
        if not (empty or (is_file(folder / RECORD) and "files" in read_json(folder / RECORD))):
            raise InputError(f"{folder}: output: not empty, and no capture; choose another folder")
        (folder / WORK).mkdir(parents=True, exist_ok=True)
        remove_temporaries(folder)
        if empty:
            write_json(folder / RECORD, {"key": None, "files": []})
    except OSError as error:
        raise cannot_write(folder, error) from error


def is_complete(folder: Path, key: str) -> bool:
    """Whether the folder has all files of the output with this key."""
    recorded, files = _record(folder)
    return recorded == key and all(is_file(folder / name) for name in files)


def replace_output(folder: Path, made: Path, key: str) -> None:
    """Move the files below `made` into the folder; those of the last output are removed.

    Another call completes an interrupted one. Raises InputError, before anything is changed, if a file that
    no capture wrote is in the way; and if the folder cannot be written.
    """
    _, before = _record(folder)
    new = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if _whole(path))
    for name in sorted({*new} - {*before}):
        if os.path.lexists(folder / name):
            raise InputError(f"{folder / name}: output: not written by a capture; move it to another folder")
    try:
        write_json(folder / RECORD, {"key": None, "files": sorted({*before, *new})})
        for name in sorted(before, key=lambda name: name != LAST):
            (folder / name).unlink(missing_ok=True)
        for name in sorted(new, key=lambda name: name == LAST):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (made / name).rename(folder / name)
        for parent in {(folder / name).parent for name in before}:
            if parent.is_dir() and not any(parent.iterdir()):
                parent.rmdir()
    except OSError as error:
        raise cannot_write(folder, error) from error
    write_json(folder / RECORD, {"key": key, "files": new})


def _whole(path: Path) -> bool:
    """Whether this is a file, and no temporary one of a killed process."""
    return path.is_file() and not TEMPORARY.fullmatch(path.name)


def _record(folder: Path) -> tuple[str | None, list[str]]:
    """Key and files of the last output; names that lead out of the folder are ignored."""
    content = read_json(folder / RECORD)
    files = content.get("files")
    names = [name for name in files if inside(folder, name)] if isinstance(files, list) else []
    return content.get("key"), names
