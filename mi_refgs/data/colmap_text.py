"""The text files of a COLMAP model: cameras.txt, images.txt, points3D.txt; and test.txt beside them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mi_refgs.data.colmap import TEST_LIST
from mi_refgs.data.lens import Lens
from mi_refgs.io.files import write_bytes

OPENCV_FROM_MITSUBA = np.diag([-1.0, -1.0, 1.0])
"""OpenCV's camera has +x right and +y down, Mitsuba's +x left and +y up."""


def write_cameras(folder: Path, cameras: Iterable[tuple[tuple[float, ...], Lens | None]]) -> None:
    """Cameras, each (width, height, fx, fy, cx, cy), pixels, and its lens, or None; numbered from 1."""
    rows = []
    for i, (numbers, lens) in enumerate(cameras, 1):
        model, coefficients = _lens(lens)
        rows.append(f"{i} {model} {' '.join(map(repr, (*numbers, *coefficients)))}")
    _write(folder / "cameras.txt", "CAMERA_ID MODEL WIDTH HEIGHT FX FY CX CY, and coefficients", rows)


def _lens(lens: Lens | None) -> tuple[str, tuple[float, ...]]:
    """COLMAP's model of a lens, and its coefficients."""
    if lens is None:
        return "PINHOLE", ()
    if lens.fisheye:
        return "OPENCV_FISHEYE", lens.radial
    k1, k2, k3 = (*lens.radial, 0.0, 0.0)[:3]
    if not k3:
        return "OPENCV", (k1, k2, *lens.tangential)
    return "FULL_OPENCV", (k1, k2, *lens.tangential, k3, 0.0, 0.0, 0.0)


def write_images(
    folder: Path,
    names: Sequence[str],
    poses: Iterable[np.ndarray],
    cameras: Sequence[int],
    seen: Sequence[str],
) -> None:
    """Pictures by name: `View.to_world` (4, 4), the number of the camera, and the line of its 2D points."""
    rows = []
    for i, (name, pose, camera, points) in enumerate(zip(names, poses, cameras, seen, strict=True), 1):
        rotation = OPENCV_FROM_MITSUBA @ pose[:3, :3].T
        numbers = (*_quaternion(rotation), *(-rotation @ pose[:3, 3]))
        rows += [f"{i} {' '.join(repr(float(x)) for x in numbers)} {camera} {name}", points]
    comment = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, and a line of X Y POINT3D_ID"
    _write(folder / "images.txt", comment, rows)


def write_points(folder: Path, rows: Sequence[str]) -> None:
    """Points, one line each."""
    _write(folder / "points3D.txt", "POINT3D_ID X Y Z R G B ERROR TRACK[IMAGE_ID POINT2D_IDX]", rows)


def write_test_list(folder: Path, names: Iterable[str]) -> None:
    """The pictures that are test views, a name a line."""
    write_bytes(folder / TEST_LIST, "".join(f"{name}\n" for name in names).encode())


def _write(path: Path, comment: str, rows: Sequence[str]) -> None:
    write_bytes(path, "\n".join((f"# {comment}", *rows, "")).encode())


def _quaternion(rotation: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) of a rotation matrix, w not negative."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z]) * (1 if w >= 0 else -1)
