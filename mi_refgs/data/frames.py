"""One frame of a transforms file: its picture, its camera, its ground-truth maps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.lens import COEFFICIENTS, Lens, Undistortion
from mi_refgs.data.picture_files import Mask, PictureFile, make_view
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.data.readers import ReadOptions
from mi_refgs.data.truth_maps import ALPHA, beside, block_mean, shiny_maps, unit
from mi_refgs.data.view import View
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.exr import read_exr_image
from mi_refgs.io.files import inside, is_file
from mi_refgs.io.images import ENDINGS, has_alpha, image_size, with_ending

SUFFIXES = (*ENDINGS, ".exr")
"""File name endings that `file_path` may carry or leave out, in the order in which they are tried."""
CAMERA_MODELS = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), False),
    **dict.fromkeys(("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"), True),
}
"""Values of `camera_model`, as COLMAP and nerfstudio name them, and whether each is a fisheye."""
OTHER_LENSES = ("k5", "k6", "ftheta_p0", "latlong", "equirectangular", "orthographic")
"""Keys of lenses that are refused, unless they are 0 or false."""


@dataclass(frozen=True)
class FrameReader:
    """Turns the frames of one transforms file into views."""

    transforms: Path
    content: dict[str, Any]
    options: ReadOptions

    def read(self, index: int, frame: Any) -> View:
        file = self._file(index, frame)
        to_world = self._to_world(index, frame)
        picture = PictureFile.find(file, self.options.downscale, self._mask(index, frame, file))
        intrinsics = self._intrinsics(frame, file, picture.height, picture.width)
        where, name = f"{self.transforms}: frames[{index}]", _stem(str(Path(frame["file_path"])))
        lens = self._lens(frame)
        view, straight = make_view(name, picture, self.options, intrinsics, lens, to_world, where)
        if not self.options.truth:
            return view
        source = (picture.height, picture.width)
        normal = self._map(index, frame, "normal_path", (*source, 3), straight)
        depth = self._map(index, frame, "depth_path", (*source, 1), straight)
        channels = {"albedo": 4, "roughness": 2, "metallic": 2}
        known = {n: self._map(index, frame, f"{n}_path", (*source, c), straight) for n, c in channels.items()}
        normal = None if normal is None else unit(normal)
        depth = None if depth is None else depth[..., 0]
        if normal is depth is None:
            normal, depth = shiny_maps(file, source, self.options.downscale, straight)
        materials = {name: values for name, values in known.items() if values is not None}
        return view.changed(normal=normal, depth=depth, materials=materials)

    def size(self, index: int, frame: Any) -> tuple[int, int]:
        """Width and height of a frame's picture as it lies in the file."""
        return image_size(self._file(index, frame))

    def _file(self, index: int, frame: Any) -> Path:
        """The picture of a frame."""
        if not isinstance(frame, dict):
            raise InputError(f"{self.transforms}: frames[{index}]: not an object; give it a file_path")
        named = self._path(index, frame, "file_path")
        if named is None:
            raise InputError(f"{self.transforms}: frames[{index}].file_path: missing; name the picture")
        if self.options.images == "exr":
            stem = named.with_name(_stem(named.name))
            there = self._path(index, frame, "exr_path") or with_ending(stem, (".exr",))
            return there or stem.with_name(f"{stem.name}.exr")
        stem = named.with_name(_stem(named.name))
        file = named if is_file(named) else with_ending(stem) or stem.with_name(stem.name + ENDINGS[0])
        if file.suffix.lower() == ".exr":
            raise InputError(f"{file}: images: the picture is an EXR file; read this data set as 'exr'")
        return file

    def _path(self, index: int, frame: dict[str, Any], key: str) -> Path | None:
        """The file that a key names; None where the frame has no such key, or an empty name."""
        name = frame.get(key)
        if name is None or name == "":
            return None
        file = inside(self.transforms.parent, name)
        if file is None:
            raise InputError(
                f"{self.transforms}: frames[{index}].{key}: {abbreviated(name)} names no file in the "
                "data set's folder; move the file there and give its relative path"
            )
        return file

    def _map(
        self,
        index: int,
        frame: dict[str, Any],
        key: str,
        expected: tuple[int, int, int],
        straight: Undistortion | None,
    ) -> np.ndarray | None:
        """A ground-truth map at the wanted size, each pixel a mean over the surface in its block.

        `expected` is the shape that the file must have: the picture's. Of two or four channels the last says
        where the others count, and comes back as the share of the block that does.
        """
        file = self._path(index, frame, key)
        if file is None:
            return None
        pixels = read_exr_image(file, vectors=True)
        if pixels.shape != expected:
            raise InputError(
                f"{file}: frames[{index}].{key}: has shape {pixels.shape} but the picture needs {expected}; "
                "export both at one size or remove the key"
            )
        masked = expected[-1] in (2, 4)
        covered = np.clip(pixels[..., -1:], 0, 1) if masked else np.any(pixels != 0, axis=-1, keepdims=True)
        mean, share = block_mean(pixels, covered, self.options.downscale, straight)
        return np.concatenate([mean[..., :-1], share], axis=-1) if masked else mean

    def _mask(self, index: int, frame: dict[str, Any], picture: Path) -> Mask | None:
        """What belongs to the object: `mask_path`, or beside a picture without alpha a file of that name."""
        if self.options.images == "exr":
            return None
        file = self._path(index, frame, "mask_path")
        if file is None and not has_alpha(picture):
            file = beside(picture, ALPHA)
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
        """The value of a key in the frame, or for the whole file; None where there is neither."""
        return frame.get(key, self.content.get(key))

    def _number(self, frame: dict[str, Any], key: str) -> float | None:
        value = self._given(frame, key)
        if value is None:
            return None
        if type(value) not in (int, float) or not abs(value) <= MAX_NUMBER:
            raise InputError(f"{self.transforms}: {key}: {abbreviated(value)} is not a number; correct it")
        return float(value)

    def _lens(self, frame: dict[str, Any]) -> Lens | None:
        """The lens of a frame; None for a pinhole."""
        model = self._given(frame, "camera_model") or "OPENCV"
        fisheye = self._given(frame, "is_fisheye") or False
        odd = [key for key in OTHER_LENSES if self._given(frame, key)]
        if not isinstance(model, str) or model not in CAMERA_MODELS or not isinstance(fisheye, bool) or odd:
            raise InputError(
                f"{self.transforms}: {odd[0] if odd else 'camera_model'}: this lens is unknown here; "
                "undistort the pictures, or give OpenCV's perspective or fisheye coefficients"
            )
        fisheye = fisheye or CAMERA_MODELS[model]
        given = {key: self._number(frame, key) or 0.0 for key in COEFFICIENTS}
        if (given["p1"] or given["p2"]) if fisheye else given["k4"]:
            field, kind = ("p1, p2", "fisheye") if fisheye else ("k4", "perspective")
            raise InputError(
                f"{self.transforms}: {field}: a {kind} lens has none here; undistort the pictures, "
                "or set it to 0"
            )
        return Lens.of(fisheye, given)

    def _intrinsics(
        self, frame: dict[str, Any], file: Path, height: int, width: int
    ) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy in pixels of the picture file."""

        def number(key: str) -> float | None:
            value = self._number(frame, key)
            if value is not None and value <= 0:
                raise InputError(
                    f"{self.transforms}: {key}: {abbreviated(value)} is not a positive number; correct it"
                )
            return value

        for key, size in (("w", width), ("h", height)):
            wanted = number(key)
            if wanted is not None and wanted != size:
                raise InputError(
                    f"{file}: {key}: the picture is {width} × {height} pixels, but {self.transforms.name} "
                    f"says {key} = {wanted:g}; restore the picture, or give only camera_angle_x"
                )
        focal: list[float | None] = []
        for length, angle, size in (("fl_x", "camera_angle_x", width), ("fl_y", "camera_angle_y", height)):
            pixels, radians = number(length), number(angle)
            if pixels is None and radians is not None:
                if not 1 / MAX_NUMBER < radians < math.pi:
                    raise InputError(
                        f"{self.transforms}: {angle}: {radians:g} is not between 0 and π; give radians"
                    )
                pixels = 0.5 * size / math.tan(radians / 2)
            focal.append(pixels)
        fx = focal[0]
        if fx is None:
            raise InputError(f"{self.transforms}: camera_angle_x: missing; give radians, or fl_x in pixels")
        return fx, focal[1] or fx, number("cx") or width / 2, number("cy") or height / 2


def _stem(name: str) -> str:
    """A file's name without an ending of SUFFIXES; any other dot is part of the name."""
    path = Path(name)
    return str(path.with_suffix("")) if path.suffix.lower() in SUFFIXES else name
