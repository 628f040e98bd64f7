"""`cameras`: the cameras of a run as transforms.json (instant-ngp, nerfstudio) and as COLMAP's text files.

    transforms.json          intrinsics and OpenGL pose of each frame; train_filenames, test_filenames
    sparse/0/cameras.txt …   the same in COLMAP's convention, without points; test.txt lists the test views

Pictures are named as in the data set, relative to it: put the files into it, or it beside them.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mi_refgs.files import make_folder, write_json
from mi_refgs.formats.format import Format, Shot

if TYPE_CHECKING:
    from mi_refgs.runs.export import TrainedScene

PICTURES = (".png", ".jpg", ".jpeg", ".exr", ".webp", ".tif", ".tiff")
"""Endings of pictures; a name without one gets the first."""


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot]) -> list[Path]:
    """Write the folder `target`; see `Format.write`."""
    from mi_refgs.data.colmap_text import write_cameras, write_images, write_points, write_test_list
    from mi_refgs.data.poses import MITSUBA_FROM_OPENGL

    sparse = target / "sparse" / "0"
    make_folder(sparse)
    names = [_file_name(shot.name) for shot in shots]
    poses = [shot.camera.pose() for shot in shots]
    frames = []
    for name, shot, pose in zip(names, shots, poses, strict=True):
        numbers = dict(zip(("w", "h", "fl_x", "fl_y", "cx", "cy"), _pinhole(shot), strict=True))
        opengl = (pose @ MITSUBA_FROM_OPENGL).tolist()
        frames.append({"file_path": name, **numbers, "transform_matrix": opengl})
    splits = {
        f"{split}_filenames": [name for name, shot in zip(names, shots, strict=True) if shot.split == split]
        for split in ("train", "test")
    }
    write_json(target / "transforms.json", {"camera_model": "PINHOLE", **splits, "frames": frames})
    pinholes = {_pinhole(shot): None for shot in shots}
    numbered = {pinhole: i for i, pinhole in enumerate(pinholes, 1)}
    write_cameras(sparse, pinholes)
    write_images(sparse, names, poses, [numbered[_pinhole(shot)] for shot in shots], [""] * len(shots))
    write_points(sparse, [])
    write_test_list(sparse, splits["test_filenames"])
    files = ("cameras.txt", "images.txt", "points3D.txt", "test.txt")
    return [target / "transforms.json", *(sparse / file for file in files)]


def _pinhole(shot: Shot) -> tuple[float, ...]:
    """Width, height, fx, fy, cx, cy in pixels, focal lengths positive."""
    camera = shot.camera
    numbers = (-camera.fx[0], -camera.fy[0], camera.cx[0], camera.cy[0])
    return camera.width, camera.height, *(float(x) for x in numbers)


def _file_name(name: str) -> str:
    path = Path(name)
    return name if path.suffix.lower() in PICTURES else f"{name}{PICTURES[0]}"


CAMERAS = Format("cameras", "transforms.json and COLMAP's text files of the cameras", "", write)
