"""PLY files of 3DGS and 2DGS that other programs have written, as scenes; and cameras of a transforms file.

Their colours are display-encoded and blended as such, which `shade.reflectance.displayed` does. A 3DGS file
is drawn by its own formula. Of 2DGS the screen filter differs, of variance 1/12 pixel² here and 1/2 there,
which counts for surfels below a pixel and for those seen edge-on; and surfels are sorted by their depth in
each tile, not by that of their centres.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.constants import MAX_NUMBER
from mi_refgs.data.poses import MITSUBA_FROM_OPENGL, rigid
from mi_refgs.errors import InputError, abbreviated
from mi_refgs.io.files import read_json
from mi_refgs.io.ply import read_header
from mi_refgs.methods.method import DataOptions, Method, Stage, SurfelOptions
from mi_refgs.runs.trained_scene import TrainedScene
from mi_refgs.shade.shading import Shading
from mi_refgs.splat import Camera
from mi_refgs.surfels.attributes import CHANNELS
from mi_refgs.surfels.ply import read_ply
from mi_refgs.surfels.table import Surfels

LENSES = ("k1", "k2", "k3", "k4", "p1", "p2", "is_fisheye")
"""Keys of lenses that are no pinholes, unless they are 0 or false."""

WANTED = "the PLY file of 3DGS or 2DGS"
"""What messages say to give."""


def read_splats(path: Path, linear: bool = False) -> TrainedScene:
    """The scene in a PLY file: positions, rotations, sizes, opacities and colours of 3D Gaussians or surfels.

    `linear`: its colours are linear radiance, as this package writes them. Raises InputError for a file that
    holds anything else.
    """
    _require_splats(path)
    surfels = read_ply(path)
    if not surfels.count:
        raise InputError(f"{path}: vertex: there are none; export the file again")
    needed = {*surfels.primitive.widths, "radiance_sh"}
    if others := [CHANNELS[name].properties[0] for name in surfels.raw if name not in needed]:
        raise InputError(
            f"{path}: {others[0]}: materials of a run, which mean nothing without its light and its shading; "
            "give the run folder to the command that needs it"
        )
    shading = Shading("surfel", "radiance") if linear else Shading("pixel", "displayed")
    return TrainedScene(Surfels(surfels.raw), None, None, shading, iteration=0, seconds=0.0)


def method_of(trained: TrainedScene, name: str) -> Method:
    """What config.toml says of a scene that was fitted elsewhere: how it is shaded."""
    surfels, shading = trained.surfels, trained.shading
    options = SurfelOptions(
        surfels.primitive.name,
        ("radiance_sh",),
        surfels.count,
        surfels.count,
        degree={"radiance_sh": surfels.sh_degree()},
    )
    stage = Stage(1, shading)
    return Method(
        1,
        {"imported": stage},
        surfels=options,
        data=DataOptions(downscale=1),
        variant=name,
        preset="standard",
    )


def _require_splats(path: Path) -> None:
    """Raise InputError for PLY files of other things, by their header."""
    try:
        with path.open("rb") as file:
            header = read_header(path, file, WANTED)
    except OSError as error:
        raise InputError(f"{path}: file: cannot be read ({error.strerror}); check the path") from error
    tables = {element.name: {name for name, _ in element.fields} for element in header.elements}
    names = tables.get("vertex", set())
    if "packed_position" in names:
        raise InputError(
            f"{path}: packed_position: a compressed PLY; write it as a plain one, as `splat-transform "
            f"{path.name} plain.ply` does"
        )
    if not {"opacity", "scale_0", "rot_0"} & names:
        what = "a mesh" if tables.get("face") is not None else "points without size or opacity"
        raise InputError(f"{path}: vertex: {what}, no Gaussians; give {WANTED}")
    if not any(name.startswith("f_dc_") for name in names):
        raise InputError(f"{path}: f_dc_0: the property is missing; export the file again with its colours")


def read_cameras(path: Path) -> list[Camera]:
    """The pinholes of a transforms.json, without their pictures.

    Keys: fl_x or camera_angle_x, fl_y, cx, cy, w, h and near (depth of the near plane, 0 by default) of the
    file or of a frame, and transform_matrix (camera to world, OpenGL's axes). Raises InputError for a file
    that lacks one or has another lens.
    """
    content = read_json(path)
    frames = content.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: frames: missing or empty; add one entry for each camera")
    return [_camera(path, content, i, frame) for i, frame in enumerate(frames)]


def _camera(path: Path, content: dict[str, Any], index: int, frame: Any) -> Camera:
    where = f"{path}: frames[{index}]"
    given = {**content, **(frame if isinstance(frame, dict) else {})}
    if lens := [key for key in LENSES if given.get(key)]:
        raise InputError(f"{where}.{lens[0]}: no pinhole; undistort the pictures, and give those cameras")

    def number(key: str, default: float | None = None) -> float:
        value: Any = given.get(key, default)
        if type(value) not in (int, float) or not abs(value) <= MAX_NUMBER:
            raise InputError(f"{where}.{key}: {abbreviated(value)} is no usable number; give one")
        return float(value)

    width, height = number("w"), number("h")
    if min(width, height) < 1 or max(width, height) > 2**14:
        raise InputError(f"{where}.w: {width:g} × {height:g} is no size of a picture; correct w and h")
    if "fl_x" in given:
        fx = number("fl_x")
    else:
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
    cx, cy = number("cx", width / 2), number("cy", height / 2)
    return Camera.from_pose(
        round(width), round(height), -fx, -fy, cx, cy, pose, max(number("near", 0.0), 0.0)
    )
