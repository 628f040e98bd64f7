"""Reader of the Blender / NeRF layout: `transforms_{split}.json` beside images, and its relatives.

Keys: `camera_angle_x` (radians) or `fl_x`, and `camera_angle_y`, `fl_y`, `cx`, `cy`, `w`, `h` (pixels), each
per frame or for the whole file; `k1` … `k4`, `p1`, `p2`, `is_fisheye`, `camera_model` (`data.lens` undoes
the distortion); `frames` with `file_path` (with or without extension) and `transform_matrix` (camera to
world, OpenGL axes); optional `exr_path`, `normal_path` (X, Y, Z, world), `depth_path` (along the viewing
axis), `albedo_path` (R, G, B, A), `roughness_path` and `metallic_path` (Y, A; A: defined there) as
`synthesis.make_dataset` writes them. Shiny Blender's maps beside the images are found by their names.

nerfstudio's `mask_path` (bright: object) becomes alpha; `ply_file_path` names points in the frame of the
poses: `applied_transform` is applied to both. `train_filenames` and `test_filenames` (or `val_filenames`)
list the images of a split.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.dataset import PointCloud, ReadOptions, Recording, held_out, make_view
from mi_refgs.data.ground_truth import ALPHA, beside, block_mean, shiny_blender_maps, unit
from mi_refgs.data.images import ImageFile, Mask
from mi_refgs.data.lens import COEFFICIENTS, Lens, Undistortion
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.view import View
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.files import inside, is_file, read_json, require_file
from mi_refgs.io.images import ENDINGS, has_alpha, image_size, linear_from_srgb, with_ending
from mi_refgs.io.ply import read_vertices

SUFFIXES = (*ENDINGS, ".exr")
"""Endings that `file_path` may have or omit, in the order in which they are tried."""
CAMERA_MODELS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), False),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), True),
}
"""Values of `camera_model`, as COLMAP and nerfstudio name them, and whether each is a fisheye."""
OTHER_LENSES = ("k5", "k6", "ftheta_p0", "latlong", "equirectangular", "orthographic")
"""Keys of unsupported lenses, refused unless they are 0 or false."""
MAPS = {"normal": 3, "depth": 1, "albedo": 4, "roughness": 2, "metallic": 2}
"""Channels of the ground-truth maps."""


class TransformsReader:
    """Reads folders with `transforms_train.json` or `transforms.json`."""

    name = "Blender / NeRF"
    looks_for = "transforms_train.json or transforms.json"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder contains a transforms file."""
        return any(folder.glob("transforms*.json"))

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training image in its file."""
        transforms, content, frames = _frames(folder, "train")
        index, frame = frames[0]
        return image_size(_FrameReader(transforms, content, ReadOptions(images=images)).image(index, frame))

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """Read the views of one split; the environment map is `environment.exr`."""
        transforms, content, frames = _frames(folder, split)
        reader = _FrameReader(transforms, content, options)
        views = tuple(reader.view(i, frame) for i, frame in frames)
        light = folder / "environment.exr"
        environment = light if light.is_file() else None
        return Recording(views, _points(transforms, content), environment, source=transforms)


def _frames(path: Path, split: str) -> tuple[Path, dict[str, Any], list[tuple[int, Any]]]:
    """The file of a split, its content, and the frames of the split with their index in the file."""
    own = path / f"transforms_{split}.json"
    shared = [p for p in (path / "transforms_train.json", path / "transforms.json") if p.is_file()]
    # A training file beside a test file is used whole; alone, it is shared by both splits.
    whole = own.is_file() and (split != "train" or (path / "transforms_test.json").is_file())
    if not whole and (split not in ("train", "test") or not shared):
        raise InputError(
            f"{path}: transforms_{split}.json: missing; give a complete data set in the Blender convention"
        )
    transforms = own if whole else shared[0]
    content = read_json(transforms)
    frames = content.get("frames")
    if not isinstance(frames, list):
        raise InputError(f"{transforms}: frames: missing or not a list; add one entry per image")
    selected = list(enumerate(frames))
    if not whole:
        names = _split_names(transforms, content, split)
        if names is not None:
            selected = [item for item in selected if _file_path(item[1]) in names]
        else:
            selected = held_out(sorted(selected, key=lambda item: _file_path(item[1])), split)
    if not selected:
        kind = {"train": "training", "test": "test"}.get(split, split)
        raise InputError(f"{transforms}: frames: zero {kind} views; add images")
    return transforms, content, selected


def _split_names(transforms: Path, content: dict[str, Any], split: str) -> set[str] | None:
    """The file paths of the frames of a split; None where the file lists no test images."""
    lists = {}
    for key in ("train", "val", "test"):
        names = content.get(f"{key}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{transforms}: {key}_filenames: not a list of paths; correct it, or remove it")
        lists[key] = {*names}
    test = lists["test"] or lists["val"]
    if not test:
        return None
    if split == "test":
        return test
    every = {_file_path(frame) for frame in content["frames"]}
    return lists["train"] or every - test - lists["val"]


def _file_path(frame: Any) -> str:
    """The `file_path` of a frame; empty without one."""
    path = frame.get("file_path") if isinstance(frame, dict) else None
    return path if isinstance(path, str) else ""


def _points(transforms: Path, content: dict[str, Any]) -> PointCloud | None:
    """The points of `ply_file_path`; None without the key, or without points of usable numbers."""
    name = content.get("ply_file_path")
    return read_points(_inside(transforms, "ply_file_path", name)) if name else None


def _inside(transforms: Path, field: str, name: object) -> Path:
    """The file in the data set's folder that a transforms file names."""
    file = inside(transforms.parent, name)
    if file is None:
        raise InputError(
            f"{transforms}: {field}: {abbreviated(name)} names no file in the data set's folder; move the "
            "file there and give its relative path"
        )
    return file


def read_points(path: Path) -> PointCloud | None:
    """Read points of a PLY file: x, y, z and red, green, blue of 8 bits or 0 … 1, sRGB-encoded.

    Points without usable numbers are left out; None without any. Raises InputError for a file that is
    missing or unusable.
    """
    require_file(path)
    with path.open("rb") as file:
        vertices = read_vertices(path, file)
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= {*names}:
        raise InputError(f"{path}: vertex: no x, y, z; export the points again")
    position = np.stack([vertices[name].astype(np.float64) for name in "xyz"], axis=-1)
    usable = (np.abs(position) <= MAX_NUMBER).all(axis=1)
    if not usable.any():
        return None
    if not {"red", "green", "blue"} <= {*names}:
        return PointCloud(position[usable])
    colour = np.stack([vertices[name][usable] for name in ("red", "green", "blue")], axis=-1)
    largest = 1 if vertices.dtype["red"].kind == "f" and not (colour > 1).any() else 255
    colour = np.clip(np.nan_to_num(colour.astype(np.float32)) / largest, 0, 1)
    return PointCloud(position[usable], linear_from_srgb(colour))


@dataclass(frozen=True)
class _FrameReader:
    """Reads the frames of one transforms file; methods raise InputError that names file and field."""

    transforms: Path
    content: dict[str, Any]
    options: ReadOptions

    def view(self, index: int, frame: Any) -> View:
        """The view of a frame, with its ground truth."""
        file = self.image(index, frame)
        where, name = f"{self.transforms}: frames[{index}]", _stem(str(Path(frame["file_path"])))
        to_world = self._to_world(index, frame)
        image = ImageFile.of(file, self.options.downscale, self._mask(index, frame, file))
        intrinsics, lens = self._intrinsics(frame, image), self._lens(frame)
        view, straight = make_view(
            image, self.options, where, name=name, intrinsics=intrinsics, lens=lens, to_world=to_world
        )
        if not self.options.truth:
            return view
        size = (image.height, image.width)
        maps = {
            name: self._map(path, f"frames[{index}].{name}_path", (*size, channels), straight)
            for name, channels in MAPS.items()
            if (path := self._path(index, frame, f"{name}_path"))
        }
        normal, depth = maps.pop("normal", None), maps.pop("depth", None)
        if normal is depth is None:
            normal, depth = shiny_blender_maps(file, size, self.options.downscale, straight)
        else:
            normal = None if normal is None else unit(normal)
            depth = None if depth is None else depth[..., 0]
        return replace(view, normal=normal, depth=depth, materials=maps)

    def image(self, index: int, frame: Any) -> Path:
        """The image file of a frame."""
        if not isinstance(frame, dict):
            raise InputError(f"{self.transforms}: frames[{index}]: not an object; give it a file_path")
        path = self._path(index, frame, "file_path")
        if path is None:
            raise InputError(f"{self.transforms}: frames[{index}].file_path: missing; name the image")
        stem = path.with_name(_stem(path.name))
        if self.options.images == "exr":
            found = self._path(index, frame, "exr_path") or with_ending(stem, (".exr",))
            return found or stem.with_name(f"{stem.name}.exr")
        file = path if is_file(path) else with_ending(stem) or stem.with_name(stem.name + ENDINGS[0])
        if file.suffix.lower() == ".exr":
            raise InputError(f"{file}: images: the image is an EXR file; read this data set as 'exr'")
        return file

    def _path(self, index: int, frame: dict[str, Any], key: str) -> Path | None:
        """The file of a key; None where the frame has no such key, or an empty name."""
        name = frame.get(key)
        return None if name in (None, "") else _inside(self.transforms, f"frames[{index}].{key}", name)

    def _map(
        self, file: Path, field: str, expected: tuple[int, int, int], straight: Undistortion | None
    ) -> np.ndarray:
        """A map of `expected` shape, at the view's size: per pixel the mean over the surface in its block.

        The last of two or four channels says where the others are defined; it becomes the fraction of the
        block where they are.
        """
        pixels = read_exr_image(file, vectors=True)
        if pixels.shape != expected:
            raise InputError(
                f"{file}: {field}: has shape {pixels.shape} but the image needs {expected}; export both "
                "at one size or remove the key"
            )
        masked = expected[-1] in (2, 4)
        covered = np.clip(pixels[..., -1:], 0, 1) if masked else np.any(pixels != 0, axis=-1, keepdims=True)
        mean, fraction = block_mean(pixels, covered, self.options.downscale, straight)
        return np.concatenate([mean[..., :-1], fraction], axis=-1) if masked else mean

    def _mask(self, index: int, frame: dict[str, Any], image: Path) -> Mask | None:
        """`mask_path`, or the file `…_alpha.png` beside an image without alpha."""
        if self.options.images == "exr":
            return None
        file = self._path(index, frame, "mask_path")
        if file is None and not has_alpha(image):
            file = beside(image, ALPHA)
        return None if file is None else Mask(file)

    def _to_world(self, index: int, frame: dict[str, Any]) -> np.ndarray:
        field = f"{self.transforms}: frames[{index}].transform_matrix"
        try:
            matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape != (4, 4):
            raise InputError(f"{field}: missing or not 4 × 4 numbers; give the camera-to-world matrix")
        return rigid(matrix, field) @ MITSUBA_FROM_OPENGL

    def _given(self, frame: dict[str, Any], key: str) -> Any:
        """The value of a key of the frame, else of the whole file; None without either."""
        return frame.get(key, self.content.get(key))

    def _number(self, frame: dict[str, Any], key: str, positive: bool = False) -> float | None:
        value = self._given(frame, key)
        if value is None:
            return None
        if type(value) not in (int, float) or not abs(value) <= MAX_NUMBER:
            raise InputError(f"{self.transforms}: {key}: {abbreviated(value)} is not a number; correct it")
        if positive and value <= 0:
            raise InputError(
                f"{self.transforms}: {key}: {abbreviated(float(value))} is not a positive number; correct it"
            )
        return float(value)

    def _lens(self, frame: dict[str, Any]) -> Lens | None:
        """The lens of a frame; None for a pinhole."""
        model = self._given(frame, "camera_model") or "OPENCV"
        fisheye = self._given(frame, "is_fisheye") or False
        odd = [key for key in OTHER_LENSES if self._given(frame, key)]
        if not isinstance(model, str) or model not in CAMERA_MODELS or not isinstance(fisheye, bool) or odd:
            raise InputError(
                f"{self.transforms}: {odd[0] if odd else 'camera_model'}: this lens is not supported; "
                "undistort the images, or give OpenCV's perspective or fisheye coefficients"
            )
        fisheye = fisheye or CAMERA_MODELS[model]
        given = {key: self._number(frame, key) or 0.0 for key in COEFFICIENTS}
        if (given["p1"] or given["p2"]) if fisheye else given["k4"]:
            field, kind = ("p1, p2", "fisheye") if fisheye else ("k4", "perspective")
            raise InputError(
                f"{self.transforms}: {field}: not supported for a {kind} lens; undistort the images, "
                "or set it to 0"
            )
        return Lens.of(fisheye, given)

    def _intrinsics(self, frame: dict[str, Any], image: ImageFile) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels of the image file."""
        width, height = image.width, image.height
        for key, size in (("w", width), ("h", height)):
            wanted = self._number(frame, key, positive=True)
            if wanted is not None and wanted != size:
                raise InputError(
                    f"{image.path}: {key}: the image has {width} × {height} pixels, but "
                    f"{self.transforms.name} says {key} = {wanted:g}; restore the image, or give only "
                    "camera_angle_x"
                )
        focal: list[float | None] = []
        for length, angle, size in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
            pixels = self._number(frame, length, positive=True)
            radians = self._number(frame, angle, positive=True)
            if pixels is None and radians is not None:
                if not 1 / MAX_NUMBER < radians < math.pi:
                    raise InputError(
                        f"{self.transforms}: {angle}: {radians:g} is not between 0 and π; give radians"
                    )
                pixels = 0.5 * size / math.tan(radians / 2)
            focal.append(pixels)
        fx, fy = focal
        if fx is None:
            raise InputError(f"{self.transforms}: camera_angle_x: missing; give radians, or fl_x in pixels")
        cx, cy = self._number(frame, "cx", positive=True), self._number(frame, "cy", positive=True)
        return fx, fy or fx, cx or width / 2, cy or height / 2


def _stem(name: str) -> str:
    """A file's name without an ending of SUFFIXES; any other dot is part of the name."""
    path = Path(name)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name
