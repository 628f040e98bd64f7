"""Triangulated initial points of a fit for data sets with known cameras but without points."""

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
from mi_refgs.data.colmap import MAX_ERROR, MIN_POINTS, MIN_VIEWS
from mi_refgs.data.dataset import Dataset, PointCloud, fitting_downscale, read_dataset
from mi_refgs.data.poses import world_to_camera
from mi_refgs.data.view import View
from mi_refgs.io.files import write_bytes
from mi_refgs.io.images import linear_from_srgb, write_png
from mi_refgs.io.ownership import RUN, OutputFolder

POINTS_FILE = "points.npz"
"""File in a run's folder: position (P, 3), colour (P, 3) linear, and key, a hash of their source."""
DAMAGED = (OSError, ValueError, KeyError, RuntimeError, EOFError, zipfile.BadZipFile, zlib.error)
"""Exceptions for a file that is missing or damaged."""
PIXELS = 1600 * 1200  # largest number of pixels of an image in which features are detected
LEAST_SIDE = 96  # shortest side, pixels, of images in which features are detected: smaller ones have too few
CLOSE, APART = 6, range(8, 24, 4)
"""Each view is matched with its CLOSE nearest views and with some farther ones, whose wider baselines give
more accurate points. On 43 hand-held images 303 pairs give as many points as all 903."""
MIN_ANGLE = 1.5  # smallest angle between the rays of a point, degrees


def with_points(data: Dataset, folder: Path, tell: Callable[[str], None]) -> PointCloud | None:
    """The initial points of a fit of `data`: its own, or those of `triangulated`.

    None for images with alpha, which have a visual hull, and if none are found. Points are kept in `folder`
    for an interrupted start. `tell` is called with messages.
    """
    enough = len(data.views) >= MIN_VIEWS and min(min(v.width, v.height) for v in data.views) >= LEAST_SIDE
    if data.points is not None or not enough or data.has_alpha:
        return data.points
    kept, key = folder / POINTS_FILE, _key(data)
    with contextlib.suppress(*DAMAGED), kept.open("rb") as opened, np.load(opened) as file:
        if file["key"] == key:
            return PointCloud(file["position"], file["colour"])
    if not colmap.installed():
        tell('no points to start from; pip install "mi_refgs[capture]" finds some, for better surfaces')
        return None
    began = time.perf_counter()
    points = triangulated(data)
    if points is None:
        tell("no points to start from: the images have too little texture in common")
        return None
    count, seconds = len(points.position), time.perf_counter() - began
    tell(f"{count} points to start from, triangulated in {seconds:.0f} s with the known cameras")
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
    """Triangulate matched features with the known cameras; None without points.

    Images are read again, as large as PIXELS allows. Points have a track of three images (two if there
    are few such points), a mean reprojection error of at most 2 pixels, and rays at 1.5° or more.

    Raises InputError as `read_dataset` does, and without pycolmap.
    """
    kind = "exr" if data.is_linear_radiance else "png"
    factor, _, _ = fitting_downscale(data.path, kind, PIXELS)
    views = read_dataset(data.path, data.split, downscale=factor, images=kind, truth=False).views
    names = [f"{i:06}.png" for i in range(len(views))]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        images, database, output = folder / "images", folder / "features.db", folder / "model"
        for part in (images, output):
            part.mkdir()
        for file, view in zip(names, views, strict=True):
            write_png(images / file, view.load().displayed)
        colmap.begin(database, images, _cameras(names, views))
        colmap.extract(database, images, names)
        colmap.match(database, [(names[i], names[j]) for i, j in near_pairs(views)])
        try:
            poses = {name: world_to_camera(view.to_world) for name, view in zip(names, views, strict=True)}
            model = colmap.triangulate(database, images, output, poses)
        except (RuntimeError, ValueError):  # nothing that matches
            return None
    return _cloud(model)


def near_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Pairs of views to match: close to each other, with similar directions."""
    origins = np.array([view.to_world[:3, 3] for view in views])
    axes = np.array([view.to_world[:3, 2] for view in views])
    extent = np.linalg.norm(origins - origins.mean(axis=0), axis=1).max() or 1.0
    apart = np.linalg.norm(origins[:, None] - origins, axis=2) / extent
    angle = np.arccos(np.clip(axes @ axes.T, -1, 1))
    order = np.argsort(apart + angle + np.diag(np.full(len(views), np.inf)), axis=1, kind="stable")
    ranks = [rank for rank in (*range(CLOSE), *APART) if rank < len(views) - 1]
    return sorted({(min(i, int(j)), max(i, int(j))) for i, near in enumerate(order) for j in near[ranks]})


def _cameras(names: Sequence[str], views: Sequence[View]) -> list[tuple[list[str], str, list[float]]]:
    """The images of each pinhole camera, with model and parameters."""
    groups: dict[tuple[float, ...], list[str]] = {}
    for name, view in zip(names, views, strict=True):
        groups.setdefault((view.width, view.height, view.fx, view.fy, view.cx, view.cy), []).append(name)
    return [(group, "PINHOLE", list(key[2:])) for key, group in groups.items()]


def _cloud(model: Any) -> PointCloud | None:
    """The reliable points of a reconstruction."""
    model.update_point_3d_errors()
    centre = {image: model.images[image].projection_center() for image in model.reg_image_ids()}
    points = list(model.points3D.values())
    length = np.array([point.track.length() for point in points], dtype=int)
    good = np.array([point.error <= MAX_ERROR for point in points], dtype=bool)
    for i in np.flatnonzero(good):
        rays = points[i].xyz - np.array([centre[element.image_id] for element in points[i].track.elements])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        good[i] = np.min(rays @ rays.T) <= np.cos(np.radians(MIN_ANGLE))
    if np.count_nonzero(good & (length >= MIN_VIEWS)) >= MIN_POINTS:
        good &= length >= MIN_VIEWS
    if not good.any():
        return None
    position = np.array([points[i].xyz for i in np.flatnonzero(good)])
    colour = np.array([points[i].color for i in np.flatnonzero(good)]) / 255
    return PointCloud(position, linear_from_srgb(colour))
