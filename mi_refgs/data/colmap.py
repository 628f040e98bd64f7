"""Reader of COLMAP's layout: a reconstruction in `sparse/0`, as text or binary, and images in `images`.

`images_2`, `images_4` and `images_8` may contain smaller copies, as in the scenes of Ref-Real and Mip-NeRF
360; `masks` may contain masks of the object, as NAME.png with or without the image's ending before it. Every
eighth image in the order of names is a test view, unless `test.txt` beside the reconstruction lists them.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np

from mi_refgs.data.colmap_model import TEST_LIST, Camera, Image, read_cameras, read_images, read_points
from mi_refgs.data.dataset import PointCloud, ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, ImageFolders
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file
from mi_refgs.io.images import image_size, linear_from_srgb

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Folders of a reconstruction, in the order in which they are tried."""
ENDINGS = ("bin", "txt")
MIN_VIEWS, MAX_ERROR = 3, 2.0
"""Track length and reprojection error, pixels, of points that are used: a single wrong match puts a point of
two images anywhere on a line, and larger errors mean such a match."""
MIN_POINTS = 100  # number of reliable points below which others are used, too


class ColmapReader:
    """Reads folders with a reconstruction by COLMAP."""

    name = "COLMAP"
    looks_for = "sparse/0/cameras.bin or .txt, beside images"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder contains a reconstruction."""
        return _model(folder) is not None

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training image in its file."""
        model = Reconstruction(folder, ReadOptions(images=images))
        return image_size(model.registered("train")[0][1])

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """Read the views of one split, and the reliable points."""
        model = Reconstruction(folder, options)
        views = tuple(model.view(*image) for image in model.registered(split))
        return Recording(views, model.points(), source=model.source, notes=model.notes())


class Reconstruction:
    """One reconstruction with its images."""

    def __init__(self, folder: Path, options: ReadOptions) -> None:
        model, ending = _model(folder) or (folder, ENDINGS[0])
        if options.images != "png":
            raise InputError(f"{folder}: images: a reconstruction has no EXR images; read it as 'png'")
        self.options = options
        self.source = model / f"images.{ending}"
        self.cameras = read_cameras(model / f"cameras.{ending}")
        self.images = read_images(self.source)
        self.point_file = model / f"points3D.{ending}"
        self.folders = ImageFolders.of(folder, flat=True)
        found = {image.name: self.folders.find(image.name, options.downscale) for image in self.images}
        self.files = {name: file for name, file in found.items() if file is not None}

    def registered(self, split: str) -> list[tuple[Image, Path, int]]:
        """The images of a split that have a file; each with that and the remaining downscale."""
        images = [image for image in self.images if image.name in self.files]
        if not images:
            raise InputError(
                f"{self.source}: none of its {len(self.images)} images is in {self.folders.folders[1]}; "
                "put them there under the same names"
            )
        test_list = self.source.with_name(TEST_LIST)
        if is_file(test_list):
            lines = test_list.read_bytes().decode("utf-8", "replace").splitlines()
            tests = {line.strip() for line in lines}
            chosen = [image for image in images if (image.name in tests) == (split == "test")]
            if not chosen:
                raise InputError(f"{test_list}: zero {split} views; name some of the images, not all")
        else:
            chosen = held_out(images, split, self.source)
        return [(image, *self.files[image.name]) for image in chosen]

    def view(self, image: Image, file: Path, downscale: int) -> View:
        """The view of an image; raises InputError for an unusable pose, lens, mask or size."""
        field = f"{self.source}: {image.name}"
        camera = self.cameras.get(image.camera)
        if camera is None:
            raise InputError(f"{field}: there is no camera {image.camera}; export the model again")
        where = f"{field}: camera {image.camera}"
        try:
            lens = camera.lens()
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        to_world = from_world_to_camera(image.rotation, image.translation, field)
        source = ImageFile.of(file, downscale, self.folders.mask(image.name))
        pinhole, name = _intrinsics(camera, source), image.name
        return make_view(
            source, self.options, where, name=name, intrinsics=pinhole, lens=lens, to_world=to_world
        )[0]

    def points(self) -> PointCloud | None:
        """The reliable points, or all where only a few are reliable; None without any."""
        if not self.point_file.is_file():
            return None
        points = read_points(self.point_file)
        good = (points.views >= MIN_VIEWS) & (points.error <= MAX_ERROR)
        if np.count_nonzero(good) < MIN_POINTS:
            good[:] = True
        if not good.any():
            return None
        colour = linear_from_srgb(points.colour[good].astype(np.float32) / 255)
        return PointCloud(points.position[good], colour)

    def notes(self) -> tuple[str, ...]:
        """What the user may want to correct."""
        notes, names = [], self.folders.names()
        if absent := len(self.images) - len(self.files):
            notes.append(f"{absent} of {len(self.images)} cameras have no image and are left out")
        if (spare := len(names) - len(self.files)) > 0:
            notes.append(f"{spare} of {len(names)} images have no camera and are left out")
        if (other := self.source.parent.with_name("1")).is_dir() and self.source.parent.name == "0":
            notes.append(f"{other.parent.name}/1 contains another reconstruction, which is left out")
        return tuple(notes)


def _model(folder: Path) -> tuple[Path, str] | None:
    """The folder of the reconstruction and the ending of its files, binary ones first as in COLMAP."""
    for place, ending in itertools.product(MODEL_FOLDERS, ENDINGS):
        if all((folder / place / f"{name}.{ending}").is_file() for name in ("cameras", "images")):
            return folder / place, ending
    return None


def _intrinsics(camera: Camera, image: ImageFile) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy in pixels of the file, which may be a smaller copy of the reconstructed image.

    Raises InputError for another aspect ratio.
    """
    across, down = image.width / camera.width, image.height / camera.height
    # Width and height of a copy are rounded by up to a pixel each.
    if abs(image.height - across * camera.height) > 1 + image.height / image.width:
        raise InputError(
            f"{image.path}: size: {image.width} × {image.height} pixels are no copy of "
            f"{camera.width} × {camera.height}, which were reconstructed; restore the image"
        )
    fx, fy, cx, cy = camera.intrinsics
    return fx * across, fy * down, cx * across, cy * down
