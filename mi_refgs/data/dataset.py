"""Reads multi-view data sets in the Blender / NeRF convention: `transforms_{split}.json` beside pictures.

Colour: PNG targets stay as displayed, sRGB-encoded, composited in that space as such data was made:
A·rgb + (1 − A)·background. EXR targets are linear and premultiplied: radiance + (1 − A)·background.

Keys: `camera_angle_x` (radians) or `fl_x`, and `camera_angle_y`, `fl_y`, `cx`, `cy`, `w`, `h` (pixels), each
in a frame or for the whole file; `k1` … `k4`, `p1`, `p2`, `is_fisheye`, `camera_model` (`data.lens` undoes the
distortion); `frames` with `file_path` (with or without extension) and `transform_matrix`
(camera to world, OpenGL axes); optional `exr_path`, `normal_path` (X, Y, Z, world) and `depth_path` (along
the viewing axis) as `data.make_dataset` writes them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.errors import InputError
from mi_refgs.files import read_json
from mi_refgs.data.transforms import FrameReader, View

HOLDOUT = 8
"""Every eighth picture is a test view where no test file exists (LLFF's habit, kept by 3DGS and 2DGS)."""
EXTENT_MARGIN = 1.1
"""Scene extent over the largest distance of a training camera to their mean (3DGS)."""
NEAR_EXTENTS = 2e-3
"""Depth of the near plane in scene extents, about 0.01 in the units of Blender's data sets: what is nearer
stands in front of the lens."""
BACKGROUNDS = {"white": 1.0, "black": 0.0}
IMAGE_KINDS = ("png", "exr")


@dataclass(frozen=True, eq=False)
class Dataset:
    """The views of one split."""

    path: Path
    split: str
    views: tuple[View, ...]
    background: np.ndarray  # (3,) float32, in the space of the targets
    linear: bool  # as in View
    environment: Path | None  # ground truth of the light: lat-long EXR in Mitsuba's orientation

    @cached_property
    def scene_extent(self) -> float:
        """1.1 × the largest distance of a camera to their mean, scene units (3DGS).

        For a lone camera that to the world's origin; 1 if it stands there.
        """
        return _extent(self.views)

    @cached_property
    def focus(self) -> np.ndarray:
        """The point (3,) nearest to all viewing axes of this split, in the least-squares sense."""
        # The ridge decides, along parallel axes, for the point nearest to the cameras' mean.
        mean = self._origins().mean(axis=0)
        system, right = np.eye(3) * 1e-6, np.zeros(3)
        for view in self.views:
            axis = view.to_world[:3, 2]
            across = np.eye(3) - np.outer(axis, axis)
            system += across
            right += across @ (view.to_world[:3, 3] - mean)
        return mean + np.linalg.solve(system, right)

    def _origins(self) -> np.ndarray:
        return np.array([view.to_world[:3, 3] for view in self.views])


def read_dataset(
    path: str | Path,
    split: str,
    *,
    downscale: int | None = None,
    background: str = "white",
    images: str = "png",
    truth: bool = True,
) -> Dataset:
    """Read one split ("train" or "test") of the data set in folder `path`.

    `downscale` averages blocks of so many pixels squared, colour premultiplied by alpha; without it pictures
    are read whole. Pixels at the right and the bottom that fill no block are left out. Without a
    `transforms_test.json` every eighth picture, in the order of their paths, is a test view and no training
    view; a lone `transforms.json` is split the same way. `truth` reads normals and depth where there are any.

    Raises InputError for anything missing, unreadable or inconsistent: file, field and remedy are named.
    """
    path = Path(path)
    if background not in BACKGROUNDS:
        raise InputError(f"{path}: background: unknown value '{background}'; give white or black")
    if images not in IMAGE_KINDS:
        raise InputError(f"{path}: images: unknown value '{images}'; give png or exr")
    downscale = 1 if downscale is None else downscale
    if downscale < 1:
        raise InputError(f"{path}: downscale: {downscale} is out of range; give a whole number from 1")
    transforms, content, frames = _frames(path, split)
    reader = FrameReader(transforms, content, downscale, BACKGROUNDS[background], images, truth)
    views = tuple(reader.read(i, frame) for i, frame in frames)
    for view in views:
        if (view.width, view.height) != (views[0].width, views[0].height):
            first = views[0]
            raise InputError(
                f"{transforms}: frames: '{view.name}' has {view.width} × {view.height} pixels but "
                f"'{first.name}' has {first.width} × {first.height}; bring all pictures to one size"
            )
    near = NEAR_EXTENTS * _extent(views)
    views = tuple(replace(view, near=near) for view in views)
    colour = np.full(3, BACKGROUNDS[background], dtype=np.float32)
    light = path / "environment.exr"
    return Dataset(path, split, views, colour, images == "exr", light if light.is_file() else None)


def fitting_downscale(path: str | Path, images: str, pixels: int) -> tuple[int, int, int]:
    """The smallest `downscale` with which the first training picture has at most so many pixels.

    Returns it with the picture's own width and height. Raises InputError as `read_dataset` does.
    """
    transforms, content, frames = _frames(Path(path), "train")
    width, height = FrameReader(transforms, content, 1, 0.0, images, False).size(*frames[0])
    factor = 1
    while factor < min(width, height) and (width // factor) * (height // factor) > pixels:
        factor += 1
    return factor, width, height


def _extent(views: tuple[View, ...]) -> float:
    origins = np.array([view.to_world[:3, 3] for view in views])
    middle = origins.mean(axis=0) if len(np.unique(origins, axis=0)) > 1 else 0
    return EXTENT_MARGIN * float(np.linalg.norm(origins - middle, axis=1).max()) or 1.0


def _frames(path: Path, split: str) -> tuple[Path, dict[str, Any], list[tuple[int, Any]]]:
    """The file that holds a split, its content, and the split's frames with their index in it."""
    if not path.is_dir():
        raise InputError(f"{path}: data set: no such folder; give one that holds transforms_train.json")
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
        order = sorted(selected, key=lambda item: _file_path(item[1]))
        selected = [item for i, item in enumerate(order) if (i % HOLDOUT == 0) == (split == "test")]
    if not selected:
        kind = {"train": "training", "test": "test"}.get(split, split)
        raise InputError(f"{transforms}: frames: zero {kind} views; add pictures")
    return transforms, content, selected


def _file_path(frame: Any) -> str:
    return str(frame.get("file_path", "")) if isinstance(frame, dict) else ""
