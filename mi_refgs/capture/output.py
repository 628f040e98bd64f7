"""The data set of a capture: undistorted images and masks, and COLMAP's files of pinhole cameras."""

import os
import shutil
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap
from mi_refgs.capture.photographs import REPORT, WORK, Photograph, mask_pixels
from mi_refgs.data.colmap_model import MODELS, Camera
from mi_refgs.data.lens import Undistortion, undistortion
from mi_refgs.errors import InputError
from mi_refgs.io.files import make_folder, read_json, replace_file
from mi_refgs.io.progress import with_bar

QUALITY = 95  # quality of JPEG files; lower ones make a fit reproduce their block edges
WRITERS = 4  # images undistorted at once, at most: with images of 12 Mpx 1.3 GB, with one 0.5 GB
SPLINE_PIXELS = 2_000_000  # up to which images are resampled with cubic splines; a fit reduces larger ones
SPARSE, IMAGES, MASKS = "sparse/0", "images", "masks"


@dataclass(frozen=True)
class Straight:
    """The pinhole camera of a group of images, and their undistortion."""

    size: tuple[int, int]  # pixels, oriented as in the data set
    focal: tuple[float, float]  # pixels
    centre: tuple[float, float]
    undo: Undistortion | None  # None without distortion: images are unchanged

    @classmethod
    def of(cls, camera: Any, size: tuple[int, int]) -> "Straight":
        """The camera for images of `size`, from a pycolmap.Camera of the working copies."""
        values = dict(zip(MODELS[camera.model_name][1].split(), camera.params, strict=True))
        known = Camera(camera.model_name, camera.width, camera.height, values)
        scale = np.divide(size, (camera.width, camera.height))
        fx, fy, cx, cy = np.array(known.intrinsics) * np.tile(scale, 2)
        try:
            lens = known.lens()
            undo = None if lens is None else undistortion(lens, *size, fx, fy, cx, cy)
        except InputError as error:
            what, remedy = f"the lens found cannot be undone ({error})", "choose another --camera-model"
            raise InputError(what, "photographs", remedy=remedy) from None
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


def straighten(model: colmap.Reconstruction, photographs: dict[str, Photograph]) -> dict[str, Straight]:
    """The undistortion of each registered image by the name of its working copy."""
    images = [model.images[i] for i in model.reg_image_ids()]
    sizes = {image.camera_id: photographs[image.name].kept_size for image in images}
    straight = {i: Straight.of(model.cameras[i], size) for i, size in sizes.items()}
    return {image.name: straight[image.camera_id] for image in images}


def prepare(folder: Path, sources: Sequence[Path]) -> None:
    """Make the folder; InputError if it is or contains one of `sources`, or anything but a capture."""
    real = folder.resolve()
    for source in sources:
        if real in (source.resolve(), *source.resolve().parents):
            what = f"it contains {source}, which is read"
            raise InputError(what, folder, "output", "choose another folder")
    own = (folder / WORK / "key").is_file()
    own = own or ((folder / REPORT).is_file() and "key" in read_json(folder / REPORT))
    if not own and folder.is_dir() and any(folder.iterdir()):
        raise InputError("not empty, and no capture", folder, "output", "choose another folder")
    make_folder(folder / WORK)


def write_images(
    placed: Sequence[Photograph], straight: dict[str, Straight], masks: dict[str, Path], folder: Path
) -> None:
    """Write images/NAME and, with masks, masks/NAME.png in place of those of the last capture."""
    for part in (IMAGES, MASKS):
        shutil.rmtree(folder / part, ignore_errors=True)
        if part == IMAGES or masks:
            (folder / part).mkdir()

    def write(photograph: Photograph) -> None:
        from PIL import Image

        camera, image = straight[photograph.copy], folder / IMAGES / photograph.name
        if camera.undo is None and photograph.plain and photograph.orientation == 1 and not photograph.lying:
            replace_file(image, partial(shutil.copyfile, photograph.path))
        else:
            jpeg = photograph.path.suffix.lower() in (".jpg", ".jpeg")
            kind = {"format": "JPEG", "quality": QUALITY, "subsampling": 0} if jpeg else {"format": "PNG"}
            pixels, exif = Image.fromarray(camera.resample(np.asarray(photograph.load()))), Image.Exif()
            exif[0x8769] = dict(photograph.exposure)
            replace_file(image, lambda path: pixels.save(path, exif=exif, **kind))
        if masks:
            mask = camera.resample(mask_pixels(masks[photograph.name], photograph))[..., 0]
            target = folder / MASKS / f"{photograph.name}.png"
            replace_file(target, lambda path: Image.fromarray(mask).save(path, format="PNG"))

    with ThreadPoolExecutor(min(os.cpu_count() or 1, WRITERS)) as pool:
        for _ in zip(pool.map(write, placed), with_bar(placed, "undistorted"), strict=True):
            pass


def write_model(
    model: colmap.Reconstruction,
    photographs: dict[str, Photograph],
    straight: dict[str, Straight],
    folder: Path,
) -> None:
    """Write COLMAP's binary files of the undistorted reconstruction."""
    written = colmap.pycolmap.Reconstruction(model)
    for i in written.reg_image_ids():
        image = written.images[i]
        camera, lens = straight[image.name], model.cameras[image.camera_id]
        rays = lens.cam_from_img(np.array([point.xy for point in image.points2D]).reshape(-1, 2))
        for point, ray in zip(image.points2D, np.asarray(rays, dtype=np.float64), strict=True):
            seen = ray * camera.focal + camera.centre
            point.xy = np.where(np.isfinite(seen), seen, 0)
        own = written.cameras[image.camera_id]
        own.model, own.width, own.height = colmap.pycolmap.CameraModelId.PINHOLE, *camera.size
        own.params = [*camera.focal, *camera.centre]
        image.name = photographs[image.name].name
    folder.mkdir(parents=True, exist_ok=True)
    colmap.write(written, folder)
