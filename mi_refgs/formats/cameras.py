"""transforms.json and COLMAP's text files of cameras: written for a scene, and transforms.json read."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.colmap_model import write_cameras, write_images, write_points, write_test_list
from mi_refgs.data.lens import Lens
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import make_folder, read_json, write_json
from mi_refgs.io.images import ENDINGS
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera

IMAGE_FOLDER = re.compile(r"images(_\d+)?")  # folders to which COLMAP's names are relative
LENSES = ("k1", "k2", "k3", "k4", "p1", "p2", "is_fisheye")
"""Keys of lenses that are no pinholes, unless they are 0 or false."""
SIZE_MAX = 2**14  # pixels along a side of an image, at most


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot]) -> list[Path]:
    """The cameras of a run as transforms.json (instant-ngp, nerfstudio) and as COLMAP's text files.

        transforms.json         intrinsics, lens and OpenGL pose per frame; train_filenames, test_filenames
        sparse/0/cameras.txt …  the same in COLMAP's convention without points; test.txt lists the test views

    Names, sizes and lenses are those of the data set's image files on disk, whatever the fit made of them.
    Paths are relative to the data set, in COLMAP's files to its folder `images` where all images are there.
    """
    sparse = target / "sparse" / "0"
    make_folder(sparse)
    names = [_file_name(shot) for shot in shots]
    poses = [shot.camera.pose() for shot in shots]
    cameras = [(_pinhole(shot), shot.file.lens if shot.file else None) for shot in shots]

    # transforms.json
    frames = []
    for name, shot, pose, (numbers, lens) in zip(names, shots, poses, cameras, strict=True):
        frame = {"file_path": name, **dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), numbers, strict=True))}
        mask = None if shot.file is None else shot.file.mask
        if mask is not None and mask.below is None:
            frame["mask_path"] = mask.path.as_posix()
        opengl = (pose @ MITSUBA_FROM_OPENGL).tolist()
        frames.append({**frame, **_coefficients(lens), "transform_matrix": opengl})
    content: dict[str, Any] = {"camera_model": frames[0]["camera_model"]}
    for split in ("train", "test"):
        content[f"{split}_filenames"] = [_file_name(shot) for shot in shots if shot.split == split]
    write_json(target / "transforms.json", {**content, "frames": frames})

    # COLMAP's model
    numbered = {camera: i for i, camera in enumerate(dict.fromkeys(cameras), 1)}
    files = _below_images(names)
    write_cameras(sparse, numbered)
    write_images(sparse, files, poses, [numbered[camera] for camera in cameras], [""] * len(shots))
    write_points(sparse, [])
    write_test_list(sparse, [file for file, shot in zip(files, shots, strict=True) if shot.split == "test"])
    written = "cameras.txt", "images.txt", "points3D.txt", "test.txt"
    return [target / "transforms.json", *(sparse / file for file in written)]


def _file_name(shot: Shot) -> str:
    if shot.file is not None:
        return shot.file.path.as_posix()
    return shot.name if Path(shot.name).suffix.lower() in ENDINGS else f"{shot.name}{ENDINGS[0]}"


def _pinhole(shot: Shot) -> tuple[float, ...]:
    """Return width, height, fx, fy, cx, cy in pixels, focal lengths positive."""
    if shot.file is not None:
        return shot.file.width, shot.file.height, *(float(x) for x in shot.file.intrinsics)
    c = shot.camera
    return c.width, c.height, *(float(x) for x in (-c.fx[0], -c.fy[0], c.cx[0], c.cy[0]))


def _coefficients(lens: Lens | None) -> dict[str, Any]:
    """Return the keys of a frame's lens as nerfstudio names them."""
    if lens is None:
        return {"camera_model": "PINHOLE"}
    found = {f"k{i}": k for i, k in enumerate(lens.radial, 1)}
    if lens.fisheye:
        return {"camera_model": "OPENCV_FISHEYE", **found}
    return {"camera_model": "OPENCV", **found, "p1": lens.tangential[0], "p2": lens.tangential[1]}


def _below_images(names: Sequence[str]) -> list[str]:
    """Remove the folder of images from the names, if all of them are in one."""
    first = names[0].partition("/")[0]
    if IMAGE_FOLDER.fullmatch(first) and all(name.startswith(f"{first}/") for name in names):
        return [name.partition("/")[2] for name in names]
    return list(names)


def read_cameras(path: Path) -> list[Camera]:
    """Read the pinhole cameras of a transforms.json; its images are not read.

    Keys: fl_x or camera_angle_x, fl_y, cx, cy, w, h and near (depth of the near plane, 0 by default) of the
    file or of a frame, and transform_matrix (camera to world, OpenGL's axes). Raises InputError for a file
    that lacks one or has another lens.
    """
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: missing or empty; add one entry for each camera")
    return [
        _camera(f"{path}: frames[{i}]", {**content, **(frame if isinstance(frame, dict) else {})})
        for i, frame in enumerate(frames)
    ]


def _camera(where: str, given: dict[str, Any]) -> Camera:
    if lens := [key for key in LENSES if given.get(key)]:
        raise InputError(f"{where}.{lens[0]}: no pinhole; undistort the images, and give those cameras")

    def number(key: str, default: float | None = None) -> float:
        value: Any = given.get(key, default)
        if type(value) not in (int, float) or not abs(value) <= MAX_NUMBER:
            raise InputError(f"{where}.{key}: {abbreviated(value)} is no usable number; give one")
        return float(value)

    width, height = number("w"), number("h")
    if min(width, height) < 1 or max(width, height) > SIZE_MAX:
        raise InputError(f"{where}.w: {width:g} × {height:g} is no size of an image; correct w and h")
    fx = number("fl_x", 0.0)
    if "fl_x" not in given:
        fx = width / 2 / math.tan(min(max(number("camera_angle_x"), 1e-3), 3.1) / 2)
    fy = number("fl_y", fx)
    if min(fx, fy) <= 0:
        raise InputError(f"{where}.fl_x: {fx:g} is no focal length; give pixels above 0")
    try:
        matrix = np.asarray(given.get("transform_matrix"), dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4):
        raise InputError(f"{where}.transform_matrix: no 4 × 4 matrix of numbers; export the file again")
    pose = rigid(matrix, f"{where}.transform_matrix") @ MITSUBA_FROM_OPENGL
    cx, cy, near = number("cx", width / 2), number("cy", height / 2), max(number("near", 0.0), 0.0)
    return Camera.from_pose(round(width), round(height), -fx, -fy, cx, cy, pose, near)
