"""Points on what pictures of known cameras show, for a fit to start from where the data set has none."""

from __future__ import annotations

import contextlib
import hashlib
import io
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mi_refgs.capture import colmap
from mi_refgs.data.dataset import Dataset, PointCloud, fitting_downscale, read_dataset
from mi_refgs.data.poses import MITSUBA_FROM_OPENCV
from mi_refgs.data.view import View
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import linear_from_srgb, write_png
from mi_refgs.io.ownership import RUN, OutputFolder

POINTS_FILE = "points.npz"
"""File in a run's folder: position (P, 3), colour (P, 3) linear, and key, a hash of their source."""
DAMAGED = (OSError, ValueError, KeyError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error)
"""Errors of a file that is missing or damaged."""
PIXELS = 1600 * 1200
"""Largest number of pixels of a picture in which features are found."""
LEAST_SIDE = 96
"""Shortest side, pixels, of pictures in which features are found: smaller ones have too few."""
CLOSE, APART = 6, range(8, 24, 4)
"""Each view is matched with its CLOSE nearest views and with some further ones, whose wider baselines place
points better. On 43 hand-held pictures 303 pairs give as many points as all 903."""
MIN_LENGTH, MIN_POINTS = 3, 100
"""Number of pictures that must have seen a point, and number of points below which two pictures suffice."""
MAX_ERROR, MIN_ANGLE = 2.0, 1.5
"""Largest mean reprojection error of a point, pixels, and least angle between its rays, degrees."""


def with_points(data: Dataset, folder: Path, tell: Callable[[str], None]) -> PointCloud | None:
    """The points that a fit of `data` starts from: its own, or those that `triangulated` finds.

    None where pictures have alpha, whose outlines say more, and where there are none to be found. They are
    kept in `folder` for an interrupted start. `tell` is called with what was done, or what would help.
    """
    enough = len(data.views) >= MIN_LENGTH and min(min(v.width, v.height) for v in data.views) >= LEAST_SIDE
    if data.points is not None or not enough or data.has_alpha:
        return data.points
    kept, key = folder / POINTS_FILE, _key(data)
    with (
        contextlib.suppress(*DAMAGED),
        kept.open("rb") as opened,
        np.load(opened, allow_pickle=False) as file,
    ):
        if file["key"] == key:
            return PointCloud(file["position"], file["colour"])
    if not colmap.installed():
        tell('no points to start from; pip install "mi_refgs[capture]" finds some, for better surfaces')
        return None
    began = time.perf_counter()
    points = triangulated(data)
    if points is None:
        tell("no points to start from: the pictures have too little texture in common")
        return None
    seconds = time.perf_counter() - began
    tell(
        f"{len(points.position)} points to start from, triangulated in {seconds:.0f} s with the known cameras"
    )
    content = io.BytesIO()
    np.savez_compressed(content, key=key, position=points.position, colour=np.asarray(points.colour))
    write_bytes(OutputFolder(folder, RUN).own(POINTS_FILE), content.getvalue())
    return points


def _key(data: Dataset) -> str:
    """A hash of the folder of a data set, and of the names, sizes and cameras of its views."""
    key = hashlib.sha256(str(data.path.resolve()).encode(errors="surrogateescape"))
    for view in data.views:
        numbers = [view.width, view.height, view.fx, view.fy, view.cx, view.cy, *view.to_world.ravel()]
        key.update(repr((view.name, [float(number) for number in numbers])).encode(errors="surrogateescape"))
    return key.hexdigest()


def triangulated(data: Dataset) -> PointCloud | None:
    """Points of features that match between views, triangulated with the known cameras; None without any.

    Pictures are read again, as large as PIXELS allows. A point counts where three pictures saw it (two, where
    hardly any has three), its mean reprojection error is at most 2 pixels and its rays meet at 1.5° or more.

    Raises InputError as `read_dataset` does, and where pycolmap is missing.
    """
    kind = "exr" if data.is_linear_radiance else "png"
    factor, _, _ = fitting_downscale(data.path, kind, PIXELS)
    views = read_dataset(data.path, data.split, downscale=factor, images=kind, truth=False).views
    names = [f"{i:06}.png" for i in range(len(views))]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        pictures, database, output = folder / "pictures", folder / "features.db", folder / "model"
        for part in (pictures, output):
            part.mkdir()
        for file, view in zip(names, views, strict=True):
            write_png(pictures / file, view.load().displayed)
        colmap.begin(database, pictures, _cameras(names, views))
        colmap.extract(database, pictures, names)
        colmap.match(database, [(names[i], names[j]) for i, j in near_pairs(views)])
        try:
            model = colmap.triangulate(database, pictures, output, poses(names, views))
        except (RuntimeError, ValueError):  # nothing that matches
            return None
    return _cloud(model)


def near_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Pairs of views to match: near each other, and with like directions."""
    origins = np.array([view.to_world[:3, 3] for view in views])
    axes = np.array([view.to_world[:3, 2] for view in views])
    extent = np.linalg.norm(origins - origins.mean(axis=0), axis=1).max() or 1.0
    apart = np.linalg.norm(origins[:, None] - origins, axis=2) / extent
    angle = np.arccos(np.clip(axes @ axes.T, -1, 1))
    order = np.argsort(apart + angle + np.diag(np.full(len(views), np.inf)), axis=1, kind="stable")
    ranks = [rank for rank in (*range(CLOSE), *APART) if rank < len(views) - 1]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, near in enumerate(order) for j in near[ranks]})


def poses(names: Sequence[str], views: Sequence[View]) -> dict[str, np.ndarray]:
    """Camera from world (3, 4) with COLMAP's axes by the picture's name."""
    result = {}
    for name, view in zip(names, views, strict=True):
        to_world = view.to_world @ MITSUBA_FROM_OPENCV
        rotation = to_world[:3, :3].T
        result[name] = np.concatenate([rotation, -rotation @ to_world[:3, 3:]], axis=1)
    return result


def _cameras(names: Sequence[str], views: Sequence[View]) -> list[tuple[list[str], str, list[float]]]:
    """The pictures of each pinhole, with its model and parameters."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for name, view in zip(names, views, strict=True):
        groups.setdefault((view.width, view.height, view.fx, view.fy, view.cx, view.cy), []).append(name)
    return [(group, "PINHOLE", list(key[2:])) for key, group in groups.items()]


def _cloud(model: Any) -> PointCloud | None:
    """The good points of a reconstruction."""
    model.update_point_3d_errors()
    centre = {image: model.images[image].projection_center() for image in model.reg_image_ids()}
    points = list(model.points3D.values())
    length = np.array([point.track.length() for point in points], dtype=int)
    good = np.array([point.error <= MAX_ERROR for point in points], dtype=bool)
    for i in np.flatnonzero(good):
        rays = points[i].xyz - np.array([centre[element.image_id] for element in points[i].track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        good[i] = np.min(rays @ rays.T) <= np.cos(np.radians(MIN_ANGLE))
    if np.count_nonzero(good & (length >= MIN_LENGTH)) >= MIN_POINTS:
        good &= length >= MIN_LENGTH
    if not good.any():
        return None
    position = np.array([points[i].xyz for i in np.flatnonzero(good)])
    colour = np.array([points[i].color for i in np.flatnonzero(good)]) / 255
    return PointCloud(position, linear_from_srgb(colour))
