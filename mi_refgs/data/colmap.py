"""COLMAP's layout: a reconstruction in `sparse/0`, as text or binary, and pictures in `images`.

The folders `images_2`, `images_4` and `images_8` may hold smaller copies, as in the scenes of Ref-Real and
Mip-NeRF 360; `masks` may hold what belongs to the object, as NAME.png, with the picture's ending before or
without. Every eighth picture in the order of names is a test view, unless `test.txt` beside the
reconstruction lists the names of those, one a line, as 3D Gaussian Splatting reads it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mi_refgs.data.colmap_model import Camera, Image, Points, read_cameras, read_images, read_points
from mi_refgs.data.picture_files import Mask, PictureFile, make_view
from mi_refgs.data.picture_folders import PictureFolders, mask_file, mask_folder
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.readers import PointCloud, ReadOptions, Recording, held_out
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file
from mi_refgs.io.images import image_size, linear_from_srgb

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Where a reconstruction may lie, in the order in which they are tried."""
ENDINGS = ("bin", "txt")
TEST_LIST = "test.txt"
MIN_VIEWS, MAX_ERROR = 3, 2.0
"""A point that two pictures show lies anywhere along a line for a single wrong match; errors beyond 2 pixels
mean such a match."""
MIN_POINTS = 100
"""Points below which none is left out."""


class ColmapReader:
    """Reads folders with a reconstruction by COLMAP."""

    name = "COLMAP"
    looks_for = "sparse/0/cameras.bin or .txt, beside images"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder holds a reconstruction."""
        return _model(folder) is not None

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training picture as it lies in its file."""
        model = Reconstruction(folder, ReadOptions(images=images))
        return image_size(model.placed("train")[0][1])

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """The views of one split, and the points that at least three pictures show."""
        model = Reconstruction(folder, options)
        views = tuple(model.view(*placed) for placed in model.placed(split))
        return Recording(views, model.points(), source=model.source, notes=model.notes())


class Reconstruction:
    """One reconstruction with its pictures."""

    def __init__(self, folder: Path, options: ReadOptions) -> None:
        model, ending = _model(folder) or (folder, ENDINGS[0])
        if options.images != "png":
            raise InputError(f"{folder}: images: a reconstruction has no EXR pictures; read it as 'png'")
        self.folder, self.options = folder, options
        self.source = model / f"images.{ending}"
        self.cameras = read_cameras(model / f"cameras.{ending}")
        self.images = read_images(self.source)
        self.point_file = model / f"points3D.{ending}"
        self.pictures = PictureFolders.of(folder, flat=True)
        self.masks = mask_folder(folder)
        found = {image.name: self._find(image.name) for image in self.images}
        self.found = {name: file for name, file in found.items() if file is not None}

    def placed(self, split: str) -> list[tuple[Image, Path, int]]:
        """The images of a split that have a file, each with it and what is left of the downscale."""
        there = [image for image in self.images if image.name in self.found]
        if not there:
            raise InputError(
                f"{self.source}: none of its {len(self.images)} pictures lies in {self.pictures.folders[1]}; "
                "put them there under the same names"
            )
        named = self._test_names()
        if named is None:
            chosen = held_out(there, split)
        else:
            chosen = [image for image in there if (image.name in named) == (split == "test")]
        if not chosen:
            remedy = "add pictures" if named is None else "name some of the pictures in test.txt, not all"
            raise InputError(f"{self.source}: zero {split} views; {remedy}")
        return [(image, *self.found[image.name]) for image in chosen]

    def view(self, image: Image, file: Path, downscale: int) -> View:
        """The view of an image."""
        field = f"{self.source}: {image.name}"
        camera = self.cameras.get(image.camera)
        if camera is None:
            raise InputError(f"{field}: there is no camera {image.camera}; export the model again")
        to_world = from_world_to_camera(image.rotation, image.translation, field)
        picture = PictureFile.find(file, downscale, self._mask(image.name))
        try:
            lens = camera.lens()
        except InputError as error:
            raise InputError(f"{field}: camera {image.camera}: {error}") from None
        intrinsics = _intrinsics(camera, picture)
        where = f"{field}: camera {image.camera}"
        return make_view(image.name, picture, self.options, intrinsics, lens, to_world, where)[0]

    def points(self) -> PointCloud | None:
        """The points that are worth a start; None without any."""
        if not self.point_file.is_file():
            return None
        points = read_points(self.point_file)
        good = _good(points)
        if not good.any():
            return None
        colour = linear_from_srgb(points.colour[good].astype(np.float32) / 255)
        return PointCloud(points.position[good], colour)

    def notes(self) -> tuple[str, ...]:
        """What a person may want to mend."""
        notes = []
        names = self.pictures.names()
        if absent := len(self.images) - len(self.found):
            notes.append(f"{absent} of {len(self.images)} cameras have no picture and are left out")
        if (spare := len(names) - len(self.found)) > 0:
            notes.append(f"{spare} of {len(names)} pictures have no camera and are left out")
        if (other := self.source.parent.with_name("1")).is_dir() and self.source.parent.name == "0":
            notes.append(f"{other.parent.name}/1 holds another reconstruction, which is left out")
        return tuple(notes)

    def _test_names(self) -> set[str] | None:
        """The names that test.txt lists; None without that file."""
        file = self.source.with_name(TEST_LIST)
        if not is_file(file):
            return None
        return {line.strip() for line in file.read_bytes().decode("utf-8", "replace").splitlines()}

    def _find(self, name: str) -> tuple[Path, int] | None:
        return self.pictures.find(name, self.options.downscale, whole=self.masks is not None)

    def _mask(self, name: str) -> Mask | None:
        return None if self.masks is None else Mask(mask_file(self.masks, name))


def _model(folder: Path) -> tuple[Path, str] | None:
    """The folder of the reconstruction and the ending of its files, binary ones first as in COLMAP."""
    for place in MODEL_FOLDERS:
        for ending in ENDINGS:
            if all((folder / place / f"{name}.{ending}").is_file() for name in ("cameras", "images")):
                return folder / place, ending
    return None


def _intrinsics(camera: Camera, picture: PictureFile) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the file, which may be a smaller copy of what was reconstructed.

    Raises InputError for one of another shape.
    """
    across, down = picture.width / camera.width, picture.height / camera.height
    # Width and height of a copy are rounded by up to a pixel each.
    if abs(picture.height - across * camera.height) > 1 + picture.height / picture.width:
        raise InputError(
            f"{picture.path}: size: {picture.width} × {picture.height} pixels are no copy of "
            f"{camera.width} × {camera.height}, which were reconstructed; restore the picture"
        )
    fx, fy, cx, cy = camera.intrinsics
    return fx * across, fy * down, cx * across, cy * down


def _good(points: Points) -> np.ndarray:
    """Which points are more than one wrong match: (P,) bool; all, where only a few are."""
    good = (points.views >= MIN_VIEWS) & (points.error <= MAX_ERROR)
    return good if np.count_nonzero(good) >= MIN_POINTS else np.ones(len(good), dtype=bool)
