"""transforms.json and COLMAP's text files of cameras: written for a scene, and transforms.json read."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mi_refgs.data.colmap_model import write_cameras, write_images, write_points, write_test_list
from mi_refgs.data.lens import COEFFICIENTS, Lens
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL
from mi_refgs.data.transforms import Frame
from mi_refgs.errors import InputError
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import make_folder, write_json
from mi_refgs.io.images import ENDINGS
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera

IMAGE_FOLDER = re.compile(r"images(_\d+)?")  # folders to which COLMAP's names are relative
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

    Keys as in `data.transforms`, and near (depth of the near plane, 0 by default). Raises InputError for a
    file without sizes, focal lengths or poses, and for another lens.
    """
    frames = Frame.all_of(path)
    if not frames:
        raise InputError(f"{path}: frames: empty; add one entry for each camera")
    return [_camera(frame) for frame in frames]


def _camera(frame: Frame) -> Camera:
    if lens := [key for key in (*COEFFICIENTS, "is_fisheye") if frame.given.get(key)]:
        raise InputError(f"{frame.field(lens[0])}: no pinhole; undistort the images, and give those cameras")
    width, height = (frame.number(key) or 0.0 for key in ("w", "h"))
    if min(width, height) < 1 or max(width, height) > SIZE_MAX:
        raise InputError(
            f"{frame.field('w')}: {width:g} × {height:g} is no size of an image; correct w and h"
        )
    fx, fy = frame.focal_lengths(width, height)
    cx, cy = (frame.number(key) for key in ("cx", "cy"))
    return Camera.from_pose(
        *(round(width), round(height), -fx, -fy),
        width / 2 if cx is None else cx,
        height / 2 if cy is None else cy,
        frame.to_world(),
        max(frame.number("near") or 0.0, 0.0),
    )
