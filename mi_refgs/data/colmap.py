"""Reader of COLMAP's layout: a reconstruction in `sparse/0`, text or binary, `images`, and perhaps `masks`.
Every eighth image by name is a test view, unless `test.txt` beside the reconstruction lists them. Of several
reconstructions, the one with most images is read."""

import contextlib
import unicodedata
from dataclasses import replace
from glob import glob
from pathlib import Path

import numpy as np

from mi_refgs.data.colmap_model import TEST_LIST, Image, read_cameras, read_images, read_points
from mi_refgs.data.dataset import PointCloud, ReadOptions, Recording, held_out, make_view
from mi_refgs.data.images import ImageFile, find_image, image_files, image_folder, mask_of
from mi_refgs.data.poses import from_world_to_camera
from mi_refgs.data.transforms import read_points as read_ply_points
from mi_refgs.data.view import View
from mi_refgs.errors import InputError, abbreviated, within
from mi_refgs.io.files import is_file
from mi_refgs.io.images import linear_from_srgb

PLACES = "sparse/* sparse colmap/sparse/* colmap/sparse dense/*/sparse dense/sparse".split()
PLACES += ["distorted/sparse/*", "colmap", "."]
"""Folders of reconstructions, in the order in which they are tried."""
ENDINGS = ("bin", "txt")
MIN_VIEWS, MAX_ERROR = 3, 2.0  # track length and error, pixels, of used points: wrong matches have others


class ColmapReader:
    """Reads folders with a reconstruction by COLMAP."""

    name = "COLMAP"
    looks_for = "sparse/0/cameras.bin or .txt, beside images"

    def recognises(self, folder: Path) -> bool:
        return bool(_models(folder))

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        model = Reconstruction(folder, options)
        views = tuple(model.view(image) for image in model.registered(split))
        return Recording(views, model.points(), source=model.source, notes=model.notes())


class Reconstruction:
    def __init__(self, folder: Path, options: ReadOptions) -> None:
        self.options, self.models = options, _models(folder)
        self.source = max(self.models, key=_registered) if len(self.models) > 1 else self.models[0]
        self.cameras = read_cameras(self.source.with_stem("cameras"))
        self.images = read_images(self.source)
        point_file = self.source.with_stem("points3D")
        self.table = read_points(point_file) if point_file.is_file() else None
        self.folder, self.root = image_folder(folder, self.source.parent)
        self.files, taken = dict[str, Path](), dict[Path, str]()
        for name in (image.name for image in self.images):
            if found := find_image((self.folder, self.root), name, options.say):
                if (other := taken.setdefault(found, name)) != name:
                    what = f"{abbreviated(name)} and {abbreviated(other)} are both {found}"
                    raise InputError(what, self.source, remedy="restore the folders of the images")
                self.files[name] = found

    def registered(self, split: str) -> list[Image]:
        images = [image for image in self.images if image.name in self.files]
        if not images:
            what = f"none of its {len(self.images)} images is in {self.folder}"
            raise InputError(what, self.source, remedy="put them there under the same names")
        test_list = self.source.with_name(TEST_LIST)
        if not is_file(test_list):
            return held_out(images, split, self.source)
        lines = test_list.read_text("utf-8-sig", "replace").splitlines()
        tests = {_plain(line): line for line in map(str.strip, lines) if line}
        for key in sorted({*tests} - {_plain(image.name) for image in self.images}):
            self.options.say(f"named in {TEST_LIST}, but not in the model", tests[key], tests[key])
        chosen = [image for image in images if (_plain(image.name) in tests) == (split == "test")]
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
        with within(where):
            lens = camera.lens()
        pose = from_world_to_camera(image.rotation, image.translation, f"{self.source}: {image.name}")
        path = self.files[image.name]
        file = ImageFile.of(path, self.options.downscale, mask_of(path, self.root))
        size = (camera.width, camera.height)
        view, _ = make_view(file, self.options, where, image.name, size, camera.intrinsics, pose, lens)
        tracks, observed = None, image.observed
        if self.table is not None and len(numbers := self.table.number):
            at = np.searchsorted(numbers, observed[:, 2]) % len(numbers)
            keypoints = observed[:, :2] * np.divide((file.width, file.height), size)
            tracks = np.hstack([keypoints, self.table.position[at]])[numbers[at] == observed[:, 2]]
        return replace(view, tracks=tracks)

    def points(self) -> PointCloud | None:
        """The reliable points, or all where only a few are reliable; None without any."""
        if (points := self.table) is None:  # some programs write them as PLY
            file = self.source.with_name("points3D.ply")
            return read_ply_points(file) if file.is_file() else None
        good = (points.views >= MIN_VIEWS) & (points.error <= MAX_ERROR)
        if np.count_nonzero(good) < 100:  # too few to start from: the others are better than none
            good[:] = True
        if not good.any():
            return None
        colour = linear_from_srgb(points.colour[good].astype(np.float32) / 255)
        return PointCloud(points.position[good], colour)

    def notes(self) -> tuple[str, ...]:
        notes, files = [], image_files(self.folder, deep=self.folder != self.root)
        if absent := len(self.images) - len(self.files):
            notes.append(f"{absent} of {len(self.images)} cameras have no image and are left out")
        if (spare := len(files) - len(self.files)) > 0:
            notes.append(f"{spare} of {len(files)} images have no camera and are left out")
        if others := len(self.models) - 1:
            chosen = f"{'/'.join(self.source.parts[-3:-1])}, of {len(self.images)} images, is read"
            notes.append(f"{chosen}; {others} smaller models are left out")
        return tuple(notes)


def _plain(name: str) -> str:
    """A name as others may write it: with composed letters, as not on macOS, and slashes."""
    return unicodedata.normalize("NFC", name).replace("\\", "/")


def _models(folder: Path) -> list[Path]:
    """The images files of the reconstructions in one place; binary ones first, as in COLMAP."""
    for place in PLACES:
        paths = [folder / name for name in sorted(glob(place, root_dir=folder))]
        files = (path / f"images.{ending}" for path in paths for ending in ENDINGS)
        found = [f for f in files if f.is_file() and f.with_stem("cameras").is_file()]
        if found:
            return [file for file in found if file.suffix == ".bin" or file.with_suffix(".bin") not in found]
    return []


def _registered(path: Path) -> int:
    """Number of images of a reconstruction; 0 if it is broken."""
    with contextlib.suppress(InputError):
        return len(read_images(path))
    return 0
