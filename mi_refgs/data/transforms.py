"""The Blender / NeRF layout: `transforms_{split}.json` beside pictures, and its relatives.

Keys: `camera_angle_x` (radians) or `fl_x`, and `camera_angle_y`, `fl_y`, `cx`, `cy`, `w`, `h` (pixels), each
in a frame or for the whole file; `k1` … `k4`, `p1`, `p2`, `is_fisheye`, `camera_model` (`data.lens` undoes
the distortion); `frames` with `file_path` (with or without extension) and `transform_matrix` (camera to
world, OpenGL axes); optional `exr_path`, `normal_path` (X, Y, Z, world), `depth_path` (along the viewing
axis), `albedo_path` (R, G, B, A), `roughness_path` and `metallic_path` (Y, A; A: defined there) as
`data.make_dataset` writes them. Shiny Blender's maps beside the pictures are found by their names
(`truth_maps`).

nerfstudio's `mask_path` (bright: object) becomes alpha; `ply_file_path` names points, which lie in the frame
of the poses: `applied_transform` is in both. `train_filenames` and `test_filenames` (or `val_filenames`) name
a split's pictures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mi_refgs.data.frames import FrameReader
from mi_refgs.data.point_file import read_points
from mi_refgs.data.readers import PointCloud, ReadOptions, Recording, held_out
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import inside, read_json


class TransformsReader:
    """Reads folders with `transforms_train.json` or `transforms.json`."""

    name = "Blender / NeRF"
    looks_for = "transforms_train.json or transforms.json"

    def recognises(self, folder: Path) -> bool:
        """Whether the folder holds a transforms file."""
        return any(folder.glob("transforms*.json"))

    def size(self, folder: Path, images: str) -> tuple[int, int]:
        """Width and height of the first training picture as it lies in its file."""
        transforms, content, frames = _frames(folder, "train")
        return FrameReader(transforms, content, ReadOptions(images=images)).size(*frames[0])

    def read(self, folder: Path, split: str, options: ReadOptions) -> Recording:
        """The views of one split; the light is `environment.exr`."""
        transforms, content, frames = _frames(folder, split)
        reader = FrameReader(transforms, content, options)
        light = folder / "environment.exr"
        views = tuple(reader.read(i, frame) for i, frame in frames)
        there = light if light.is_file() else None
        return Recording(views, _points(transforms, content), environment=there, source=transforms)


def _frames(path: Path, split: str) -> tuple[Path, dict[str, Any], list[tuple[int, Any]]]:
    """The file that holds a split, its content, and the split's frames with their index in it."""
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
        raise InputError(f"{transforms}: frames: missing or not a list; add one entry for each picture")
    selected = list(enumerate(frames))
    if not whole:
        named = _named(transforms, content, split)
        if named is not None:
            selected = [item for item in selected if _file_path(item[1]) in named]
        else:
            selected = held_out(sorted(selected, key=lambda item: _file_path(item[1])), split)
    if not selected:
        kind = {"train": "training", "test": "test"}.get(split, split)
        raise InputError(f"{transforms}: frames: zero {kind} views; add pictures")
    return transforms, content, selected


def _named(transforms: Path, content: dict[str, Any], split: str) -> set[str] | None:
    """The file paths of a split's frames; None where the file names no test pictures."""
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


def _points(transforms: Path, content: dict[str, Any]) -> PointCloud | None:
    """The points that `ply_file_path` names; None without the key, or without points of usable numbers."""
    name = content.get("ply_file_path")
    if not name:
        return None
    file = inside(transforms.parent, name)
    if file is None:
        raise InputError(
            f"{transforms}: ply_file_path: {abbreviated(name)} names no file in the data set's folder; move "
            "it there"
        )
    return read_points(file)


def _file_path(frame: Any) -> str:
    """The path that a frame names; empty where it names none."""
    path = frame.get("file_path") if isinstance(frame, dict) else None
    return path if isinstance(path, str) else ""
