"""COLMAP's model files cameras, images and points3D: read as text or binary, written as text.

COLMAP's own library is not used: it is large and allocates what a file promises. Here every number of
records is compared with the length of the file first.
"""

from __future__ import annotations

import itertools
import struct
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.lens import Lens
from mi_refgs.data.poses import world_to_camera
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
TEST_LIST = "test.txt"
"""File beside the model with the names of the test views, one per line, as 3D Gaussian Splatting reads it."""
MAX_NAME = 4096  # bytes of an image's name; no path is longer


@dataclass(frozen=True)
class Camera:
    """Camera model and intrinsics."""

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
            raise InputError("k4, k5, k6: rational distortion is not supported; undistort the images")
        return Lens.of(fisheye, self.values)


@dataclass(frozen=True, eq=False)
class Image:
    """A registered image: a world point x is at rotation @ x + translation in OpenCV's axes."""

    name: str  # path relative to the folder of images
    camera: int
    rotation: np.ndarray  # (3, 3) float64
    translation: np.ndarray  # (3,)


@dataclass(frozen=True, eq=False)
class Points:
    """Triangulated points."""

    position: np.ndarray  # (P, 3) float64, world
    colour: np.ndarray  # (P, 3) uint8, sRGB-encoded
    error: np.ndarray  # (P,) mean reprojection error, pixels; −1 or 0: unknown
    views: np.ndarray  # (P,) track length: number of images that show it


class Cursor:
    """Position in the bytes of a binary file; raises ValueError where the file ends early."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next values, little-endian without padding."""
        size = struct.calcsize(f"<{layout}")
        if self.at + size > len(self.data):
            raise ValueError(f"ends after {len(self.data)} bytes, within a record")
        self.at += size
        return struct.unpack_from(f"<{layout}", self.data, self.at - size)

    def count(self, row: int) -> int:
        """The next number, of records of at least `row` bytes that follow."""
        (number,) = self.take("Q")
        if number * row > len(self.data) - self.at:
            raise ValueError(f"{number} records are more than the file contains")
        return int(number)

    def skip(self, row: int) -> int:
        """Skip a list of records of `row` bytes each, after their number, which is returned."""
        number = self.count(row)
        self.at += number * row
        return number

    def name(self) -> str:
        """The next zero-terminated text."""
        end = self.data.find(b"\0", self.at, self.at + MAX_NAME)
        if end < 0:
            raise ValueError("a name has no end")
        text = self.data[self.at : end].decode()  # UnicodeDecodeError is a ValueError
        self.at = end + 1
        return text


def read_cameras(path: Path) -> dict[int, Camera]:
    """The cameras by their number; raises InputError for an unusable file and for an unknown lens."""
    rows = _records(path, _binary_cameras, _text_cameras)
    return {number: _camera(path, number, *rest) for number, *rest in rows}


def read_images(path: Path) -> list[Image]:
    """The images sorted by name; raises InputError for a file that cannot be used."""
    images = []
    for name, camera, quaternion, translation in _records(path, _binary_images, _text_images):
        values = np.array([*quaternion, *translation], dtype=np.float64)
        length = float(np.linalg.norm(values[:4])) if np.abs(values).max() <= MAX_NUMBER else 0.0
        if not length > 0:
            raise InputError(
                f"{path}: {abbreviated(name)}: the pose has no usable numbers; remove the image, or "
                "reconstruct again"
            )
        images.append(Image(name, camera, _rotation(values[:4] / length), values[4:]))
    images.sort(key=lambda image: image.name)
    if twice := [a.name for a, b in itertools.pairwise(images) if a.name == b.name]:
        raise InputError(f"{path}: {abbreviated(twice[0])}: the image occurs twice; remove one of the two")
    return images


def read_points(path: Path) -> Points:
    """The points with usable numbers; raises InputError for an unusable file."""
    table = np.array([*_records(path, _binary_points, _text_points)], dtype=np.float64).reshape(-1, 8)
    table = table[(np.abs(table[:, :3]) <= MAX_NUMBER).all(axis=1)]
    colour = np.clip(table[:, 3:6], 0, 255).astype(np.uint8)
    return Points(table[:, :3], colour, table[:, 6], table[:, 7].astype(np.int64))


def _records(path: Path, binary: Any, text: Any) -> list[tuple[Any, ...]]:
    """The records of a file, by its ending; raises InputError if it is missing or broken."""
    try:
        if path.suffix == ".bin":
            cursor = Cursor(path.read_bytes())
            rows = [*binary(cursor)]
            if cursor.at < len(cursor.data):
                raise ValueError(f"{len(cursor.data) - cursor.at} bytes follow the last record")
        else:
            with path.open(encoding="utf-8") as lines:
                rows = [*text(line.strip() for line in lines)]
    except OSError as error:
        raise InputError(f"{path}: file: cannot be read ({error.strerror}); restore it") from error
    except (ValueError, OverflowError) as error:
        raise InputError(
            f"{path}: COLMAP: broken ({str(error)[:100]}); copy the file, or export the model again"
        ) from error
    return rows


def _binary_cameras(cursor: Cursor) -> Iterator[tuple[Any, ...]]:
    names = {number: name for name, (number, _) in MODELS.items()}
    for _ in range(cursor.count(24)):
        camera, number, width, height = cursor.take("iiQQ")
        model = names.get(number, f"number {number}")
        values = cursor.take("d" * len(MODELS[model][1].split())) if model in MODELS else ()
        yield camera, model, width, height, values
        if model not in MODELS:  # the length of its record is unknown; `_camera` refuses it
            cursor.at = len(cursor.data)
            return


def _text_cameras(lines: Iterator[str]) -> Iterator[tuple[Any, ...]]:
    for line in _without_comments(lines):
        camera, model, width, height, *values = line.split()
        yield int(camera), model, int(width), int(height), tuple(map(float, values))


def _camera(
    path: Path, number: int, model: str, width: int, height: int, values: tuple[float, ...]
) -> Camera:
    field = f"{path}: camera {number}"
    if model not in MODELS:
        raise InputError(
            f"{field}: the lens model {abbreviated(model)} is not supported; undistort the images "
            "(colmap image_undistorter), or use the model OPENCV"
        )
    names = MODELS[model][1].split()
    if len(values) != len(names) or not all(abs(value) <= MAX_NUMBER for value in values):
        raise InputError(f"{field}: {model} needs {len(names)} numbers; export the model again")
    camera = Camera(model, width, height, dict(zip(names, values, strict=True)))
    if not (0 < width <= MAX_NUMBER and 0 < height <= MAX_NUMBER and min(camera.intrinsics[:2]) > 0):
        raise InputError(f"{field}: its size and focal length are not positive; export the model again")
    return camera


def _binary_images(cursor: Cursor) -> Iterator[tuple[Any, ...]]:
    for _ in range(cursor.count(73)):
        _, *pose, camera = cursor.take("i7di")
        yield cursor.name(), camera, pose[:4], pose[4:]
        cursor.skip(24)  # observations: x, y, number of the point


def _text_images(lines: Iterator[str]) -> Iterator[tuple[Any, ...]]:
    for line in _without_comments(lines):
        _, w, x, y, z, *translation, camera, name = line.split(maxsplit=9)
        if len(translation) != 3:
            raise ValueError("an image has no pose, camera and name")
        yield name, int(camera), [float(c) for c in (w, x, y, z)], [float(c) for c in translation]
        if len(next(lines, "").split()) % 3:  # observations: x, y, number of the point
            raise ValueError("an image is not followed by a line of points, which may be empty")


def _binary_points(cursor: Cursor) -> Iterator[tuple[Any, ...]]:
    for _ in range(cursor.count(51)):
        _, *numbers = cursor.take("Q3d3Bd")
        yield *numbers, cursor.skip(8)  # the track: image and index of the observation


def _text_points(lines: Iterator[str]) -> Iterator[tuple[Any, ...]]:
    for line in _without_comments(lines):
        _, *words = line.split()
        if len(words) < 7:
            raise ValueError("a point has no position, colour and error")
        yield *map(float, words[:7]), len(words[7:]) // 2


def _without_comments(lines: Iterator[str]) -> Iterator[str]:
    """Lines that are neither empty nor comments; the caller may read the line after one from `lines`."""
    return (line for line in lines if line and not line.startswith("#"))


def _rotation(quaternion: np.ndarray) -> np.ndarray:
    """The matrix (3, 3) of a unit quaternion (w, x, y, z)."""
    w, x, y, z = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def write_cameras(folder: Path, cameras: Iterable[tuple[tuple[float, ...], Lens | None]]) -> None:
    """Write cameras.txt: per camera (width, height, fx, fy, cx, cy), pixels, and lens; numbered from 1."""
    rows = []
    for i, (numbers, lens) in enumerate(cameras, 1):
        given = {} if lens is None else lens.coefficients
        model = "PINHOLE" if lens is None else lens.model
        model = "FULL_OPENCV" if model == "OPENCV" and given.get("k3") else model
        coefficients = [given.get(name, 0.0) for name in MODELS[model][1].split()[4:]]
        rows.append(f"{i} {model} {' '.join(map(repr, (*numbers, *coefficients)))}")
    _write(folder / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY, and coefficients", rows)


def write_images(
    folder: Path,
    names: Sequence[str],
    poses: Iterable[np.ndarray],  # `View.to_world` (4, 4)
    cameras: Sequence[int],
    observations: Sequence[str],  # lines of X Y POINT3D_ID
) -> None:
    """Write images.txt; all sequences have one item per image."""
    rows = []
    given = zip(names, poses, cameras, observations, strict=True)
    for i, (name, pose, camera, points) in enumerate(given, 1):
        matrix = world_to_camera(pose)
        numbers = (*_quaternion(matrix[:, :3]), *matrix[:, 3])
        rows += [f"{i} {' '.join(repr(float(x)) for x in numbers)} {camera} {name}", points]
    comment = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of X Y POINT3D_ID"
    _write(folder / "images.txt", comment, rows)


def write_points(folder: Path, rows: Sequence[str]) -> None:
    """Write points3D.txt, one line per point."""
    _write(folder / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR TRACK[IMAGE_ID POINT2D_IDX]", rows)


def write_test_list(folder: Path, names: Iterable[str]) -> None:
    """Write the names of the test views, one per line."""
    write_bytes(folder / TEST_LIST, "".join(f"{name}\n" for name in names).encode())


def _write(path: Path, comment: str, rows: Sequence[str]) -> None:
    write_bytes(path, "\n".join((f"# {comment}", *rows, "")).encode())


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) of a rotation matrix, w not negative."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)
