"""`cameras`: the cameras of a run as transforms.json (instant-ngp, nerfstudio) and as COLMAP's text files.

    transforms.json          intrinsics, lens and OpenGL pose of each frame; train_filenames, test_filenames
    sparse/0/cameras.txt …   the same in COLMAP's convention, without points; test.txt lists the test views

Names, sizes and lenses are those of the data set's image files on disk, whatever the fit made of them. Paths
are relative to the data set, in COLMAP's files to its folder `images` where all images are there.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mi_refgs.formats.format import Format, Shot
from mi_refgs.io.files import make_folder, write_json

if TYPE_CHECKING:
    from mi_refgs.data.lens import Lens
    from mi_refgs.runs.trained_scene import TrainedScene

IMAGE_FOLDER = re.compile(r"images(_\d+)?")
"""Folders to which COLMAP's names are relative."""


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot]) -> list[Path]:
    """Write the folder `target`; see `Format.write`."""
    from mi_refgs.data.colmap_model import write_cameras, write_images, write_points, write_test_list
    from mi_refgs.data.poses import MITSUBA_FROM_OPENGL

    sparse = target / "sparse" / "0"
    make_folder(sparse)
    names = [_file_name(shot) for shot in shots]
    poses = [shot.camera.pose() for shot in shots]
    cameras = [(_pinhole(shot), shot.file.lens if shot.file else None) for shot in shots]
    frames = []
    for name, shot, pose, (numbers, lens) in zip(names, shots, poses, cameras, strict=True):
        frame = {"file_path": name, **dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), numbers, strict=True))}
        mask = None if shot.file is None else shot.file.mask
        if mask is not None and mask.below is None:
            frame["mask_path"] = mask.path.as_posix()
        opengl = (pose @ MITSUBA_FROM_OPENGL).tolist()
        frames.append({**frame, **_coefficients(lens), "transform_matrix": opengl})
    splits = {
        f"{split}_filenames": [name for name, shot in zip(names, shots, strict=True) if shot.split == split]
        for split in ("train", "test")
    }
    model = {"camera_model": frames[0]["camera_model"]}
    write_json(target / "transforms.json", {**model, **splits, "frames": frames})
    numbered = {camera: i for i, camera in enumerate(dict.fromkeys(cameras), 1)}
    write_cameras(sparse, numbered)
    files = _below_images(names)
    write_images(sparse, files, poses, [numbered[camera] for camera in cameras], [""] * len(shots))
    write_points(sparse, [])
    write_test_list(sparse, [f for f, shot in zip(files, shots, strict=True) if shot.split == "test"])
    written = ("cameras.txt", "images.txt", "points3D.txt", "test.txt")
    return [target / "transforms.json", *(sparse / file for file in written)]


def _file_name(shot: Shot) -> str:
    from mi_refgs.io.images import ENDINGS

    if shot.file is not None:
        return shot.file.path.as_posix()
    return shot.name if Path(shot.name).suffix.lower() in ENDINGS else f"{shot.name}{ENDINGS[0]}"


def _pinhole(shot: Shot) -> tuple[float, ...]:
    """Width, height, fx, fy, cx, cy in pixels, focal lengths positive."""
    if shot.file is not None:
        return shot.file.width, shot.file.height, *(float(x) for x in shot.file.intrinsics)
    camera = shot.camera
    numbers = (-camera.fx[0], -camera.fy[0], camera.cx[0], camera.cy[0])
    return camera.width, camera.height, *(float(x) for x in numbers)


def _coefficients(lens: Lens | None) -> dict[str, Any]:
    """The lens of a frame as nerfstudio names it."""
    if lens is None:
        return {"camera_model": "PINHOLE"}
    found = {f"k{i}": k for i, k in enumerate(lens.radial, 1)}
    if lens.fisheye:
        return {"camera_model": "OPENCV_FISHEYE", **found}
    return {"camera_model": "OPENCV", **found, "p1": lens.tangential[0], "p2": lens.tangential[1]}


def _below_images(names: Sequence[str]) -> list[str]:
    """The names without the folder of images that all are in, if they are."""
    first = names[0].partition("/")[0]
    if IMAGE_FOLDER.fullmatch(first) and all(name.startswith(f"{first}/") for name in names):
        return [name.partition("/")[2] for name in names]
    return list(names)


CAMERAS = Format("cameras", "transforms.json and COLMAP's text files of the cameras", "", write)
