"""transforms.json and COLMAP's text files of cameras: written for a scene, and transforms.json read."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.data.colmap_model import write_model
from mi_refgs.data.lens import COEFFICIENTS
from mi_refgs.data.poses import MITSUBA_FROM_OPENCV, MITSUBA_FROM_OPENGL
from mi_refgs.data.transforms import Frame
from mi_refgs.data.view import FileCamera
from mi_refgs.errors import InputError
from mi_refgs.formats.format import Shot
from mi_refgs.io.files import read_any_json, write_json
from mi_refgs.io.images import ENDINGS
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.splat.camera import Camera

TRANSFORMS = "transforms.json"
SIZE_MAX = 2**14  # pixels along a side of an image, at most


def write(trained: TrainedScene, target: Path, shots: Sequence[Shot]) -> list[Path]:
    """The cameras of a run as transforms.json (instant-ngp, nerfstudio) and as COLMAP's text files.

        transforms.json         intrinsics, lens and OpenGL pose per frame; train_filenames, test_filenames
        sparse/0/cameras.txt …  the same in COLMAP's convention without points; test.txt lists the test views

    Names, sizes and lenses are those of the data set's image files on disk, whatever the fit made of them.
    Paths are relative to the data set, in COLMAP's files to its folder `images` where all images are there.
    """
    sparse = target / "sparse" / "0"
    write_json(target / TRANSFORMS, transforms(shots))
    files = [_file(shot) for shot in shots]
    names = [file.path.as_posix() for file in files]
    poses = [shot.camera.pose() for shot in shots]
    cameras = [((file.width, file.height, *map(float, file.intrinsics)), file.lens) for file in files]
    numbered = {camera: i for i, camera in enumerate(dict.fromkeys(cameras), 1)}
    folder = re.match(r"images(_\d+)?/", names[0])  # to which COLMAP's names are relative
    below = names
    if folder and all(name.startswith(folder[0]) for name in names):
        below = [name.removeprefix(folder[0]) for name in names]
    tests = [name for name, shot in zip(below, shots, strict=True) if shot.split == "test"]
    write_model(sparse, numbered, below, poses, [numbered[camera] for camera in cameras], tests)
    written = "cameras.txt", "images.txt", "points3D.txt", "test.txt"
    return [target / TRANSFORMS, *(sparse / file for file in written)]


def transforms(shots: Sequence[Shot]) -> dict[str, Any]:
    """Return the content of the transforms.json of `write`."""
    frames: list[dict[str, Any]] = []
    listed: dict[str, list[str]] = {"train": [], "test": []}
    for shot in shots:
        file = _file(shot)
        name, lens = file.path.as_posix(), file.lens
        listed[shot.split].append(name)
        frame: dict[str, Any] = {"file_path": name, "w": file.width, "h": file.height}
        frame |= zip(("fl_x", "fl_y", "cx", "cy"), map(float, file.intrinsics), strict=True)
        if file.mask is not None and file.mask.below is None:
            frame["mask_path"] = file.mask.path.as_posix()
        frame["camera_model"] = "PINHOLE" if lens is None else lens.model
        frame |= lens.coefficients if lens else {}
        frame["transform_matrix"] = (shot.camera.pose() @ MITSUBA_FROM_OPENGL).tolist()
        frames.append(frame)
    names = {f"{split}_filenames": found for split, found in listed.items()}
    return {"camera_model": frames[0]["camera_model"], **names, "frames": frames}


def _file(shot: Shot) -> FileCamera:
    """Return the image file of a shot; without one, what its name and camera say of it."""
    if shot.file is not None:
        return shot.file
    c, ending = shot.camera, "" if Path(shot.name).suffix.lower() in ENDINGS else ENDINGS[0]
    intrinsics = (-float(c.fx[0]), -float(c.fy[0]), float(c.cx[0]), float(c.cy[0]))
    return FileCamera(Path(f"{shot.name}{ending}"), c.width, c.height, intrinsics)


def read_cameras(path: Path, offset: Sequence[float] = (0, 0, 0)) -> list[Camera]:
    """Read the pinhole cameras of a transforms.json, or of the cameras.json of 3DGS, a list; images are not
    read. Keys as in `data.transforms`, and near (depth of the near plane, 0 by default). Those nearer to the
    `offset` of a run than to the origin become relative to it, as the run is. Raises InputError for a file
    without sizes, focal lengths or poses, and for another lens."""
    content = read_any_json(path)
    listed = isinstance(content, list)
    frames = [_listed(path, *pair) for pair in enumerate(content)] if listed else Frame.all_of(path)
    if not frames:
        raise InputError("empty", path, "frames", "add one entry for each camera")
    return [_camera(frame, np.array(offset)) for frame in frames]


def _listed(path: Path, index: int, entry: Any) -> Frame:
    """A camera of 3DGS: camera-to-world rotation of OpenCV's axes, position, and pixels."""
    pose = np.eye(4)
    try:
        pose[:3, :3], pose[:3, 3] = entry["rotation"], entry["position"]
        keys = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy"}
        own = {key: entry[theirs] for key, theirs in keys.items()}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        what, remedy = "no camera of 3DGS", "give its cameras.json, or a transforms.json"
        raise InputError(what, path, f"[{index}]", remedy) from error
    own["transform_matrix"] = (pose @ MITSUBA_FROM_OPENCV @ MITSUBA_FROM_OPENGL).tolist()
    return Frame(path, f"[{index}]", own, own)


def _camera(frame: Frame, offset: np.ndarray) -> Camera:
    if frame.lens() is not None:
        field = next((key for key in (*COEFFICIENTS, "is_fisheye") if frame.given.get(key)), "camera_model")
        raise frame.refuse(field, "no pinhole", "undistort the images, and give those cameras")
    width, height = (frame.number(key) or 0.0 for key in ("w", "h"))
    if not all(1 <= side <= SIZE_MAX and side.is_integer() for side in (width, height)):
        raise frame.refuse("w", f"{width:g} × {height:g} is no size of an image", "correct w and h")
    fx, fy, cx, cy = frame.pinhole(width, height)
    near = max(frame.number("near") or 0.0, 0.0)
    pose = frame.to_world()
    if np.linalg.norm(pose[:3, 3] - offset) < np.linalg.norm(pose[:3, 3]):
        pose[:3, 3] -= offset
    return Camera.from_pose(int(width), int(height), -fx, -fy, cx, cy, pose, near)
