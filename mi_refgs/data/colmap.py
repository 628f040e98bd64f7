"""Reader of COLMAP's layout: a reconstruction in `sparse/0`, text or binary, `images`, and perhaps `masks`.
Every eighth image by name is a test view, unless `test.txt` beside the reconstruction lists them."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_refgs.data.colmap_model import TEST_LIST, Camera, Image, read_cameras, read_images, read_points
from mi_refgs.data.dataset import PointCloud, ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, ImageFolder
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.view import View
from mi_refgs.errors import InputError
from mi_refgs.io.files import is_file
from mi_refgs.io.images import linear_from_srgb

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse")
"""Folders of a reconstruction, in the order in which they are tried."""
ENDINGS = ("bin", "txt")
MIN_VIEWS, MAX_ERROR = 3, 2.0  # track length and error, pixels, of used points: wrong matches have others
MIN_POINTS = 100  # number of reliable points below which others are used, too


class ColmapReader:
    """Reads folders with a reconstruction by COLMAP."""

    name = "COLMAP"
    looks_for = "sparse/0/cameras.bin or .txt, beside images"

    def recognises(self, folder: Path) -> bool:
        return _model(folder) is not None

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        model = Reconstruction(folder, options)
        views = tuple(model.view(image) for image in model.registered(split))
        return Recording(views, model.points(), source=model.source, notes=model.notes())


class Reconstruction:
    def __init__(self, folder: Path, options: ReadOptions) -> None:
        model, ending = _model(folder) or (folder, ENDINGS[0])
        options.require_png(folder)
        self.options = options
        self.source = model / f"images.{ending}"
        self.cameras = read_cameras(model / f"cameras.{ending}")
        self.images = read_images(self.source)
        point_file = model / f"points3D.{ending}"
        self.table = read_points(point_file) if point_file.is_file() else None
        self.folder = ImageFolder.of(folder, flat=True)
        found = {image.name: self.folder.find(image.name) for image in self.images}
        self.files = {name: file for name, file in found.items() if file is not None}

    def registered(self, split: str) -> list[Image]:
        images = [image for image in self.images if image.name in self.files]
        if not images:
            what = f"none of its {len(self.images)} images is in {self.folder.path}"
            raise InputError(what, self.source, remedy="put them there under the same names")
        test_list = self.source.with_name(TEST_LIST)
        if not is_file(test_list):
            return held_out(images, split, self.source)
        tests = {line.strip() for line in test_list.read_text("utf-8", "replace").splitlines()}
        chosen = [image for image in images if (image.name in tests) == (split == "test")]
        if not chosen:
            raise InputError(f"zero {split} views", test_list, remedy="name some of the images, not all")
        return chosen

    def view(self, image: Image) -> View:
        """The view of an image; raises InputError for an unusable pose, lens, mask or size."""
        camera = self.cameras.get(image.camera)
        if camera is None:
            remedy = "export the model again"
            raise InputError(f"there is no camera {image.camera}", self.source, image.name, remedy)
        where = f"{self.source}: {image.name}: camera {image.camera}"
        try:
            lens = camera.lens()
        except InputError as error:
            raise error.at(file=where) from None
        pose = from_world_to_camera(image.rotation, image.translation, f"{self.source}: {image.name}")
        file = ImageFile.of(self.files[image.name], self.options.downscale, self.folder.mask(image.name))
        view = make_view(file, self.options, where, image.name, _intrinsics(camera, file), pose, lens)[0]
        tracks, observed = None, image.observed
        if self.table is not None and len(numbers := self.table.number):
            at = np.searchsorted(numbers, observed[:, 2]) % len(numbers)
            keypoints = observed[:, :2] * (file.width / camera.width, file.height / camera.height)
            tracks = np.hstack([keypoints, self.table.position[at]])[numbers[at] == observed[:, 2]]
        return replace(view, tracks=tracks)

    def points(self) -> PointCloud | None:
        """The reliable points, or all where only a few are reliable; None without any."""
        if (points := self.table) is None:
            return None
        good = (points.views >= MIN_VIEWS) & (points.error <= MAX_ERROR)
        if np.count_nonzero(good) < MIN_POINTS:
            good[:] = True
        if not good.any():
            return None
        colour = linear_from_srgb(points.colour[good].astype(np.float32) / 255)
        return PointCloud(points.position[good], colour)

    def notes(self) -> tuple[str, ...]:
        notes, names = [], self.folder.names()
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
    """fx, fy, cx, cy in pixels of the file, perhaps a smaller copy; InputError for another aspect ratio."""
    across, down = image.width / camera.width, image.height / camera.height
    # Width and height of a copy are rounded by up to a pixel each.
    if abs(image.height - across * camera.height) > 1 + image.height / image.width:
        what = f"{image.width} × {image.height} pixels are no copy of {camera.width} × {camera.height}"
        raise InputError(f"{what}, which were reconstructed", image.path, "size", "restore the image")
    fx, fy, cx, cy = camera.intrinsics
    return fx * across, fy * down, cx * across, cy * down
