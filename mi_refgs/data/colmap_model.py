"""COLMAP's model files: read as text or binary, written as text. COLMAP's own library is an extra, and
allocates what a file promises before it compares the file's length."""

import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.lens import Lens
from mi_refgs.data.poses import MITSUBA_FROM_OPENCV
from mi_refgs.data.view import evenly_spread
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import write_bytes

MODELS: dict[str, tuple[int, str]] = {
    "SIMPLE_PINHOLE": (0, "f cx cy"),
    "PINHOLE": (1, "fx fy cx cy"),
    "SIMPLE_RADIAL": (2, "f cx cy k1"),
    "RADIAL": (3, "f cx cy k1 k2"),
    "OPENCV": (4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": (5, "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": (6, "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
    "SIMPLE_RADIAL_FISHEYE": (8, "f cx cy k1"),
    "RADIAL_FISHEYE": (9, "f cx cy k1 k2"),
    "SIMPLE_FISHEYE": (14, "f cx cy"),
    "FISHEYE": (15, "fx fy cx cy"),
}
"""Camera models whose distortion can be undone: number in binary files, parameters in their order."""
TEST_LIST = "test.txt"  # beside the model: names of the test views, one per line, as 3DGS reads it


@dataclass(frozen=True)
class Camera:
    model: str
    width: int  # pixels
    height: int
    values: dict[str, float]  # by the names in MODELS, pixels of an image of that size

    @property
    def intrinsics(self) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy, where (½, ½) is the centre of the first pixel."""
        v = self.values
        return v.get("fx", v.get("f", 0.0)), v.get("fy", v.get("f", 0.0)), v["cx"], v["cy"]

    def lens(self) -> Lens | None:
        """None for a pinhole; raises InputError without a file's name for unsupported coefficients."""
        fisheye = self.model.endswith("FISHEYE")
        if not fisheye and any(self.values.get(name) for name in ("k4", "k5", "k6")):
            what = "rational distortion is not supported"
            raise InputError(what, field="k4, k5, k6", remedy="undistort the images")
        return Lens.of(fisheye, self.values)


@dataclass(frozen=True, eq=False)
class Image:
    """A registered image: a world point x is at rotation @ x + translation in OpenCV's axes."""

    name: str  # path relative to the folder of images
    camera: int
    rotation: np.ndarray  # (3, 3) float64
    translation: np.ndarray  # (3,)
    observed: np.ndarray  # (K, 3): column and row of keypoints, pixels; numbers of their points


@dataclass(frozen=True, eq=False)
class Points:
    position: np.ndarray  # (P, 3) float64, world
    colour: np.ndarray  # (P, 3) uint8, sRGB-encoded
    error: np.ndarray  # (P,) mean reprojection error, pixels; −1 or 0: unknown
    views: np.ndarray  # (P,) track length: number of images that show it
    number: np.ndarray  # (P,) by which images name it, ascending


class _Cursor:
    """Position in the bytes of a binary file; raises ValueError where the file ends early."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values, little-endian without padding."""
        start, self.at = self.at, self.at + struct.calcsize(f"<{layout}")
        if self.at > len(self.data):
            raise ValueError(f"ends after {len(self.data)} bytes, within a record")
        return struct.unpack_from(f"<{layout}", self.data, start)

    def count(self, row: int) -> int:
        """The next number, of records of at least `row` bytes that follow."""
        (number,) = self.take("Q")
        if number * row > len(self.data) - self.at:
            raise ValueError(f"{number} records are more than the file contains")
        return int(number)

    def name(self) -> str:
        start, self.at = self.at, self.data.find(b"\0", self.at, self.at + 4096) + 1  # no path is longer
        if not self.at:
            raise ValueError("a name has no end")
        return self.data[start : self.at - 1].decode()  # UnicodeDecodeError is a ValueError


def read_cameras(path: Path) -> dict[int, Camera]:
    """The cameras by their number; raises InputError for an unusable file and for an unknown lens."""
    cameras: dict[int, Camera] = {}
    for number, model, width, height, *values in _records(path, _binary_cameras, _text_cameras):
        field, again = f"camera {number}", "export the model again"
        if model not in MODELS:
            remedy = "undistort the images (colmap image_undistorter), or use the model OPENCV"
            raise InputError(f"the lens model {abbreviated(model)} is not supported", path, field, remedy)
        names = MODELS[model][1].split()
        if len(values) != len(names) or not all(abs(value) <= MAX_NUMBER for value in values):
            raise InputError(f"{model} needs {len(names)} numbers", path, field, again)
        camera = Camera(model, width, height, dict(zip(names, values, strict=True)))
        if not (0 < width <= MAX_NUMBER and 0 < height <= MAX_NUMBER and min(camera.intrinsics[:2]) > 0):
            raise InputError("its size and focal length are not positive", path, field, again)
        cameras[number] = camera
    return cameras


def read_images(path: Path) -> list[Image]:
    """The images sorted by name; raises InputError for a file that cannot be used."""
    images: dict[str, Image] = {}
    for name, observed, camera, *pose in _records(path, _binary_images, _text_images):
        values = np.array(pose, dtype=np.float64)
        if not (np.abs(values).max() <= MAX_NUMBER and np.linalg.norm(values[:4]) > 0):
            remedy = "remove the image, or reconstruct again"
            raise InputError("the pose has no usable numbers", path, abbreviated(name), remedy)
        if name in images:
            raise InputError("the image occurs twice", path, abbreviated(name), "remove one of the two")
        rotation = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix()  # COLMAP's w is first
        observed = observed[(observed[:, 2] >= 0) & np.isfinite(observed).all(axis=1)]
        observed = observed[evenly_spread(len(observed), 500)]  # enough for a median, and read at once
        images[name] = Image(name, camera, rotation, values[4:], observed)
    return [images[name] for name in sorted(images)]


def read_points(path: Path) -> Points:
    """The points with usable numbers; raises InputError for an unusable file."""
    table = np.array([*_records(path, _binary_points, _text_points)], dtype=np.float64).reshape(-1, 9)
    table = table[np.argsort(table[:, 8])]
    table = table[(np.abs(table[:, :3]) <= MAX_NUMBER).all(axis=1)]
    colour = np.clip(table[:, 3:6], 0, 255).astype(np.uint8)
    return Points(table[:, :3], colour, table[:, 6], table[:, 7].astype(np.int64), table[:, 8])


Records = Iterator[tuple[Any, ...]]


def _records(path: Path, binary: Callable[[_Cursor], Records], text: Callable[[Any], Records]) -> list[Any]:
    """The records of a file, by its ending; raises InputError if it is missing or broken."""
    try:
        if path.suffix == ".bin":
            cursor = _Cursor(path.read_bytes())
            rows = [*binary(cursor)]
            if cursor.at < len(cursor.data):
                raise ValueError(f"{len(cursor.data) - cursor.at} bytes follow the last record")
        else:
            with path.open(encoding="utf-8-sig") as lines:
                rows = [*text(line.strip() for line in lines)]
    except OSError as error:
        raise InputError(f"cannot be read ({error.strerror})", path, "file", "restore it") from error
    except (ValueError, OverflowError) as error:
        remedy = "copy the file, or export the model again"
        raise InputError(f"broken ({str(error)[:100]})", path, "COLMAP", remedy) from error
    return rows


def _binary_cameras(cursor: _Cursor) -> Records:
    names = {number: name for name, (number, _) in MODELS.items()}
    for _ in range(cursor.count(24)):
        camera, number, width, height = cursor.take("iiQQ")
        model = names.get(number, f"number {number}")
        values = cursor.take("d" * len(MODELS[model][1].split())) if model in MODELS else ()
        yield camera, model, width, height, *values
        if model not in MODELS:  # the length of its record is unknown; `read_cameras` refuses it
            cursor.at = len(cursor.data)
            return


def _text_cameras(lines: Iterator[str]) -> Records:
    for line in _without_comments(lines):
        camera, model, width, height, *values = line.split()
        yield int(camera), model, int(width), int(height), *map(float, values)


def _binary_images(cursor: _Cursor) -> Records:
    for _ in range(cursor.count(73)):
        _, *pose, camera = cursor.take("i7di")
        name, count = cursor.name(), cursor.count(24)
        rows = np.frombuffer(cursor.data, "<f8, <f8, <i8", count, cursor.at)
        cursor.at += rows.nbytes
        yield name, np.stack([rows[f"f{i}"] for i in range(3)], axis=-1), camera, *pose


def _text_images(lines: Iterator[str]) -> Records:
    for line in _without_comments(lines):
        _, *pose, camera, name = line.split(maxsplit=9)
        if len(pose) != 7:
            raise ValueError("an image has no pose, camera and name")
        words = next(lines, "").split()
        if len(words) % 3:
            raise ValueError("an image is not followed by a line of points, which may be empty")
        yield name, np.array(words, dtype=np.float64).reshape(-1, 3), int(camera), *map(float, pose)


def _binary_points(cursor: _Cursor) -> Records:
    for _ in range(cursor.count(51)):
        number, *numbers = cursor.take("Q3d3Bd")
        length = cursor.count(8)
        cursor.at += 8 * length  # the track: image and index of the observation
        yield *numbers, length, number


def _text_points(lines: Iterator[str]) -> Records:
    for line in _without_comments(lines):
        number, *words = line.split()
        if len(words) < 7:
            raise ValueError("a point has no position, colour and error")
        yield *map(float, words[:7]), len(words[7:]) // 2, float(number)


def _without_comments(lines: Iterator[str]) -> Iterator[str]:
    """Lines that are neither empty nor comments; a caller may read the line after one from `lines`."""
    return (line for line in lines if line and not line.startswith("#"))


def write_model(
    folder: Path,
    cameras: Iterable[tuple[tuple[float, ...], Lens | None]],  # (width, height, fx, fy, cx, cy), pixels; lens
    names: Sequence[str],  # of the images
    poses: Iterable[np.ndarray],  # `View.to_world` (4, 4)
    camera_of: Iterable[int],  # number of each image's camera, from 1
    tests: Iterable[str],  # names of the test views
) -> None:
    """Write cameras.txt, images.txt, points3D.txt without points, and test.txt."""
    rows, images = list[str](), list[str]()
    for i, (numbers, lens) in enumerate(cameras, 1):
        given = {} if lens is None else lens.coefficients
        model = "PINHOLE" if lens is None else lens.model
        model = "FULL_OPENCV" if model == "OPENCV" and given.get("k3") else model
        coefficients = [given.get(name, 0.0) for name in MODELS[model][1].split()[4:]]
        rows.append(f"{i} {model} {' '.join(map(repr, (*numbers, *coefficients)))}")
    for i, (name, pose, camera) in enumerate(zip(names, poses, camera_of, strict=True), 1):
        rotation = (pose[:3, :3] @ MITSUBA_FROM_OPENCV[:3, :3]).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
        values = " ".join(repr(float(value)) for value in (w, x, y, z, *(-rotation @ pose[:3, 3])))
        images += [f"{i} {values} {camera} {name}", ""]
    files = {
        "cameras.txt": ["# CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY, and coefficients", *rows],
        "images.txt": ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of points", *images],
        "points3D.txt": ["# POINT3D_ID X Y Z R G B ERROR TRACK[IMAGE_ID POINT2D_IDX]"],
        TEST_LIST: tests,
    }
    for name, lines in files.items():
        write_bytes(folder / name, "".join(f"{line}\n" for line in lines).encode())
