"""Reader of the Blender / NeRF layout: `transforms_{split}.json` beside images, and its relatives.

Keys, per frame or for the whole file: `camera_angle_x` (radians) or `fl_x`, `camera_angle_y`, `fl_y`, `cx`,
`cy`, `w`, `h` (pixels), and of the lens `k1` … `k4`, `p1`, `p2`, `is_fisheye`, `camera_model`. `frames` have
`file_path` (with or without extension), `transform_matrix` (camera to world, OpenGL axes) and optionally
`exr_path`, `normal_path` (X, Y, Z, world), `depth_path` (along the viewing axis), `albedo_path` (R, G, B, A),
`roughness_path`, `metallic_path` (Y, A; A: defined there), and `mask_path` (bright: object). Without it and
without alpha, the file of the image's name in `masks` is the mask. `ply_file_path` names points in the frame
of the poses; `train_filenames` and `test_filenames` (or `val_filenames`) list the images of a split."""

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.colmap_model import MODELS
from mi_refgs.data.dataset import PointCloud, ReadOptions, Recording, held_out, make_view, require_own_names
from mi_refgs.data.images import FOLDERS, MARKS, ImageFile, Mask, block_mean, find_image, mask_of
from mi_refgs.data.lens import COEFFICIENTS, Lens, Undistortion
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.view import View
from mi_refgs.errors import InputError, abbreviated, counted
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.files import inside, is_file, read_json
from mi_refgs.io.images import ENDINGS, linear_from_srgb, read_png, read_tiff, with_ending
from mi_refgs.io.ply import read_vertices

SUFFIXES = (*ENDINGS, ".exr")  # that `file_path` may have or omit, in the order in which they are tried
OTHER_LENSES = ("k5", "k6", "ftheta_p0", "latlong", "equirectangular", "orthographic")
"""Keys of unsupported lenses, refused unless they are 0 or false."""
MAPS = {"normal": 3, "depth": 1, "albedo": 4, "roughness": 2, "metallic": 2}  # channels of ground truth


class TransformsReader:
    """Reads folders with `transforms_train.json` or `transforms.json`."""

    name = "Blender, NeRF, nerfstudio"
    looks_for = "transforms_train.json or transforms.json"

    def recognises(self, folder: Path) -> bool:
        return any(folder.glob("transforms*.json"))

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        frames = _frames(folder, split)
        views = tuple(_view(frame, options) for frame in frames)
        light, points = folder / "environment.exr", frames[0].path("ply_file_path", options)
        cloud = read_points(points) if points else None
        return Recording(views, cloud, light if light.is_file() else None, source=frames[0].file)


@dataclass(frozen=True)
class Frame:
    """One frame of a transforms file; methods raise InputError that names file and field."""

    file: Path
    place: str  # of the frame in the file, for messages
    own: dict[str, Any]  # the keys of the frame
    given: dict[str, Any]  # the same, and those of the whole file that it lacks

    @staticmethod
    def all_of(file: Path) -> "list[Frame]":
        content = read_json(file)
        frames = content.get("frames")
        if not isinstance(frames, list):
            raise InputError("missing or not a list", file, "frames", "add one entry per image")
        for i, own in enumerate(frames):
            if not isinstance(own, dict):
                raise InputError("not an object", file, f"frames[{i}]", "give it a file_path")
        known = ({key: x for key, x in own.items() if x is not None} for own in frames)
        return [Frame(file, f"frames[{i}]", own, content | own) for i, own in enumerate(known)]

    @property
    def name(self) -> str:
        name = self.own.get("file_path")
        return name if isinstance(name, str) else ""

    def refuse(self, key: str, what: str, remedy: str) -> InputError:
        return InputError(what, self.file, f"{self.place}.{key}" if key in self.own else key, remedy)

    def path(self, key: str, options: ReadOptions) -> Path | None:
        """The file of a key, or where it is missing; None where there is no such key, or an empty name."""
        name, root = self.given.get(key), self.file.parent
        if name in (None, ""):
            return None
        more = [root / folder for folder in FOLDERS] if key.endswith("file_path") else []
        file = find_image((root, *more), str(name), options.say) or inside(root, name)
        if file is None:
            what = f"{abbreviated(name)} names no file in the data set's folder"
            raise self.refuse(key, what, "move the file there and give its relative path")
        return file

    def number(self, key: str, positive: bool = False) -> float | None:
        value = self.given.get(key)
        if value is None:
            return None
        if type(value) not in (int, float) or not abs(value) <= MAX_NUMBER or (positive and value <= 0):
            kind = "a positive number" if positive else "a number"
            raise self.refuse(key, f"{abbreviated(value)} is not {kind}", "correct it")
        return float(value)

    def to_world(self, options: ReadOptions | None = None) -> np.ndarray:
        """`View.to_world`, from `transform_matrix`."""
        field = f"{self.place}.transform_matrix"
        try:
            matrix = np.array(self.own["transform_matrix"], dtype=np.float64)
        except (KeyError, TypeError, ValueError, OverflowError):
            matrix = np.empty(0)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0, 0, 0, 1]])
        if matrix.shape != (4, 4):
            raise InputError("missing or not 4 × 4 numbers", self.file, field, "give camera to world")
        made = rigid(matrix, f"{self.file}: {field}")
        if made is not matrix and options is not None:
            options.say("the rotation is rounded or scaled, and made orthonormal", self.place, field)
        return made @ MITSUBA_FROM_OPENGL

    def lens(self) -> Lens | None:
        """The lens; None for a pinhole."""
        model = self.given.get("camera_model") or "OPENCV"
        fisheye = self.given.get("is_fisheye") or False
        odd = [key for key in OTHER_LENSES if self.given.get(key)]
        if odd or str(model).upper() not in MODELS or not isinstance(fisheye, bool):
            remedy = "undistort the images, or give OpenCV's perspective or fisheye coefficients"
            what = f"the lens {odd[0] if odd else abbreviated(model)} is not supported"
            raise self.refuse(odd[0] if odd else "camera_model", what, remedy)
        fisheye = fisheye or model.upper().endswith("FISHEYE")
        given = {key: self.number(key) or 0.0 for key in COEFFICIENTS}
        for key in ("p1", "p2") if fisheye else ("k4",):
            if given[key]:
                what = f"not supported for a {'fisheye' if fisheye else 'perspective'} lens"
                raise self.refuse(key, what, "undistort the images, or set it to 0")
        return Lens.of(fisheye, given)

    def pinhole(self, width: float, height: float) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, pixels of an image of this size."""
        focal: list[float | None] = []
        for length, angle, size in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
            pixels, radians = self.number(length, positive=True), self.number(angle, positive=True)
            if pixels is None and radians is not None:
                if not 1 / MAX_NUMBER < radians < math.pi:
                    raise self.refuse(angle, f"{radians:g} is not between 0 and π", "give radians")
                pixels = 0.5 * size / math.tan(radians / 2)
            focal.append(pixels)
        if focal[0] is None:
            raise InputError("missing", self.file, "camera_angle_x", "give radians, or fl_x in pixels")
        cx, cy = self.number("cx"), self.number("cy")
        middle = width / 2 if cx is None else cx, height / 2 if cy is None else cy
        return focal[0], focal[1] or focal[0], *middle


def _frames(folder: Path, split: str) -> list[Frame]:
    tests = [p for x in ("test", "val") if (p := folder / f"transforms_{x}.json").is_file()]
    own = tests[0] if split == "test" and tests else folder / f"transforms_{split}.json"
    shared = [p for p in (folder / "transforms_train.json", folder / "transforms.json") if p.is_file()]
    # A training file beside a test file is used whole; alone, it is shared by both splits.
    whole = own.is_file() and (split != "train" or bool(tests))
    if not whole and (split not in ("train", "test") or not shared):
        raise InputError("missing", folder, own.name, "give a complete data set in the Blender convention")
    file = own if whole else shared[0]
    frames = Frame.all_of(file)
    if not whole and frames:
        names = _split_names(frames, split)
        if names is None:
            require_own_names((frame.name for frame in frames), file)  # of both splits
            frames = held_out(sorted(frames, key=lambda frame: frame.name), split)
        else:
            frames = [frame for frame in frames if os.path.normpath(frame.name) in names]
    if not frames:
        raise InputError(f"zero {split} views", file, "frames", "add images")
    return frames


def _split_names(frames: list[Frame], split: str) -> set[str] | None:
    """The file paths of the frames of a split; None where the file lists no test images."""
    lists, every = {}, {os.path.normpath(frame.name) for frame in frames}
    for key in ("train", "val", "test"):
        names = frames[0].given.get(f"{key}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError("not a list of paths", frames[0].file, f"{key}_filenames", "correct it")
        lists[key] = {*map(os.path.normpath, names)}
        if lost := sorted(lists[key] - every):
            what = f"{counted(len(lost), 'path')} of no frame, such as {abbreviated(lost[0])}"
            raise InputError(what, frames[0].file, f"{key}_filenames", "write them as `file_path` does")
    test = lists["test"] or lists["val"]
    if not test:
        return {*held_out(sorted(lists["train"]), split)} or None
    if split == "test":
        return test
    return lists["train"] or every - test - lists["val"]


def read_points(path: Path) -> PointCloud | None:
    """Read x, y, z and red, green, blue (8 bits or 0 … 1, sRGB) of a PLY file; None without usable points."""
    vertices = read_vertices(path)
    names = vertices.dtype.names or ()
    if not {"x", "y", "z"} <= {*names}:
        raise InputError("no x, y, z", path, "vertex", "export the points again")
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


def _view(frame: Frame, options: ReadOptions) -> View:
    file = _image(frame, options)
    image = ImageFile.of(file, options.downscale)
    if (mask := frame.path("mask_path", options)) == file:
        raise frame.refuse("mask_path", "it is the image", "name a mask")
    marks = MARKS[1:-1] if image.has_alpha() else MARKS[1:]  # a copy of its own alpha is no other mask
    image = replace(image, mask=Mask(mask) if mask else mask_of(file, frame.file.parent, marks))
    name, where = _stem(str(Path(frame.name))), f"{frame.file}: {frame.place}"
    width, height = frame.number("w", positive=True), frame.number("h", positive=True)
    width = width or image.width * (height or image.height) / image.height
    height = height or image.height * width / image.width
    camera = (frame.pinhole(width, height), frame.to_world(options), frame.lens())
    view, straight = make_view(image, options, where, name, (width, height), *camera)
    if not options.truth:
        return view
    size = (image.height, image.width)
    maps = {
        name: _map(path, f"{frame.place}.{name}_path", (*size, channels), options.downscale, straight)
        for name, channels in MAPS.items()
        if (path := frame.path(f"{name}_path", options))
    }
    normal, depth = maps.pop("normal", None), maps.pop("depth", None)
    if normal is depth is None:
        normal, depth = _shiny_blender_maps(file, size, options.downscale, straight)
    if normal is not None:
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normal = np.where(length > 0, normal / np.maximum(length, 1e-12), 0).astype(np.float32)
    depth = None if depth is None else depth[..., 0]
    return replace(view, normal=normal, depth=depth, materials=maps)


def _image(frame: Frame, options: ReadOptions) -> Path:
    path = frame.path("file_path", options)
    if path is None:
        raise InputError("missing", frame.file, f"{frame.place}.file_path", "name the image")
    stem = path.with_name(_stem(path.name))
    if options.images == "exr":
        linear = frame.path("exr_path", options) or with_ending(stem, (".exr",))
        return linear or stem.with_name(f"{stem.name}.exr")
    return path if is_file(path) else stem.with_name(stem.name + ENDINGS[0])


def _map(
    file: Path, field: str, expected: tuple[int, int, int], downscale: float, straight: Undistortion | None
) -> np.ndarray:
    """A map of `expected` shape, at the view's size: per pixel the mean over the surface in its block. The
    last of two or four channels, where the others are defined, becomes the fraction of the block."""
    pixels = read_exr_image(file, vectors=True)
    if pixels.shape != expected:
        remedy = "export both at one size or remove the key"
        raise InputError(f"has shape {pixels.shape} but the image needs {expected}", file, field, remedy)
    masked = expected[-1] in (2, 4)
    covered = np.clip(pixels[..., -1:], 0, 1) if masked else np.any(pixels != 0, axis=-1, keepdims=True)
    mean, fraction = block_mean(pixels, covered, downscale, straight)
    return np.concatenate([mean[..., :-1], fraction], axis=-1) if masked else mean


def _stem(name: str) -> str:
    """A file's name without an ending of SUFFIXES."""
    return str(Path(name).with_suffix("")) if Path(name).suffix.lower() in SUFFIXES else name


def _beside(
    image: Path, ending: str, read: Callable[[Path], np.ndarray], shape: tuple[int, int]
) -> np.ndarray | None:
    """The map (H, W, …) of an image whose name has this ending; None without one."""
    file = image.with_name(image.stem + ending)
    pixels = read(file) if is_file(file) else None
    if pixels is not None and pixels.shape[:2] != shape:
        what = f"{pixels.shape[1]} × {pixels.shape[0]} pixels, but the image has {shape[1]} × {shape[0]}"
        raise InputError(what, file, "size", "restore the map, or remove it")
    return pixels


def _shiny_blender_maps(
    image: Path, shape: tuple[int, int], downscale: float, straight: Undistortion | None
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """World normals n (h, w, 3) in 8 bits as (n + 1) / 2, and depths z (h, w, 1) as 1 / (1 + z), 0 off the
    object, beside an image of Shiny Blender; None without a file. [Ref-NeRF, Verbin et al. 2022]"""
    normal = depth = None
    if (pixels := _beside(image, "_normal.png", read_png, shape)) is not None:
        pixels = 2 * pixels[..., :3] - 1
        stored = np.linalg.norm(pixels, axis=-1, keepdims=True) > 0.5  # none is stored as (½, ½, ½)
        normal = block_mean(pixels, stored, downscale, straight)[0]
    if (pixels := _beside(image, "_disp.tiff", read_tiff, shape)) is not None:
        disparity = pixels[..., None]
        covered = (disparity > 0) & (disparity < 1)
        depths = np.where(covered, 1 / np.where(covered, disparity, 1) - 1, 0).astype(np.float32)
        depth = block_mean(depths, covered, downscale, straight)[0]
    return normal, depth
