"""A path-traced data set as COLMAP's text files: `images/`, and `sparse/0/` with exact cameras and points.

Images are numbered so that every eighth is a test view, as readers of COLMAP split them, while there are test
views; `sparse/0/test.txt` lists all of them. Points are surface points of equal colour in the views that see
them, as structure from motion finds them: mirrors have few.
"""

from __future__ import annotations

import shutil
from functools import partial
from pathlib import Path

import numpy as np

from mi_refgs.data.colmap_model import write_cameras, write_images, write_points, write_test_list
from mi_refgs.data.dataset import HOLDOUT
from mi_refgs.data.region import REGION_FILE
from mi_refgs.io.files import replace_file
from mi_refgs.io.images import read_png
from mi_refgs.io.ownership import OutputFolder
from mi_refgs.synthesis.pathtrace import Cameras, Tracer

CANDIDATES = 40_000  # surface points that are sampled; those of equal colour are kept
POINT_VIEWS = 4  # largest track length of a point
SAME_COLOUR = 0.04
"""Largest standard deviation of a point's encoded colour over the views of its track: three times the noise
of 64 samples per pixel."""
SAME_PLACE = 1e-3
"""Largest relative difference of depths for which a view sees a point and nothing in front of it."""


def colmap_output(folder: Path, data: Path, cameras: Cameras) -> OutputFolder:
    """Claim the COLMAP files of the data set in `data`; raises InputError if a foreign file is in the way."""
    output = OutputFolder(folder, f"colmap of {data.resolve()}")
    sparse = (f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D", "test"))
    output.claim(*sparse, REGION_FILE, *(f"images/{i:04d}.png" for i in range(len(_order(cameras)[0]))))
    return output


def write_colmap(output: OutputFolder, data: Path, tracer: Tracer) -> None:
    """Write the finished data set in `data` as COLMAP; raises InputError if a file cannot be written."""
    folder = output.path
    names, poses, tests = _order(tracer.cameras)
    sparse, images = folder / "sparse" / "0", folder / "images"
    files = [f"{i:04d}.png" for i in range(len(names))]
    copies = {data / f"{name}.png": images / file for name, file in zip(names, files, strict=True)}
    if (data / REGION_FILE).is_file():
        copies[data / REGION_FILE] = folder / REGION_FILE
    for source, target in copies.items():
        replace_file(target, partial(shutil.copyfile, source))
    options = tracer.cameras.options
    (width, height), focal = options.resolution, options.focal
    shown = np.stack([read_png(images / file)[..., :3] for file in files])
    points, colours, tracks, places = _points(shown, poses, tracer, focal, options.seed)

    write_cameras(sparse, [((width, height, focal, focal, width / 2, height / 2), None)])
    seen: list[list[str]] = [[] for _ in files]
    rows = []
    for i, (point, colour) in enumerate(zip(points, colours, strict=True)):
        track = []
        for view, (x, y) in zip(tracks[i], places[i], strict=True):
            track.append(f"{view + 1} {len(seen[view])}")
            seen[view].append(f"{x:.3f} {y:.3f} {i + 1}")
        r, g, b = np.round(255 * colour).astype(int)
        rows.append(f"{i + 1} {' '.join(f'{c:.6f}' for c in point)} {r} {g} {b} 0 {' '.join(track)}")
    write_points(sparse, rows)
    write_images(sparse, files, poses, [1] * len(files), [" ".join(places) for places in seen])
    write_test_list(sparse, [files[i] for i in tests])


def _order(cameras: Cameras) -> tuple[list[str], np.ndarray, list[int]]:
    """Names without ending and poses (N, 4, 4) of all views, and the indices of the test views among them."""
    left = {s: [(f"{s}/r_{i:03d}", p) for i, (p, _) in enumerate(cameras.of(s))] for s in ("train", "test")}
    names: list[str] = []
    poses: list[np.ndarray] = []
    tests: list[int] = []
    while any(left.values()):
        split = "train" if len(names) % HOLDOUT else "test"
        split = split if left[split] else {"train": "test", "test": "train"}[split]
        tests += [len(names)] if split == "test" else []
        name, pose = left[split].pop(0)
        names.append(name)
        poses.append(pose)
    return names, np.stack(poses), tests


def _points(
    shown: np.ndarray, poses: np.ndarray, tracer: Tracer, focal: float, seed: int
) -> tuple[np.ndarray, np.ndarray, list[np.ndarray], list[np.ndarray]]:
    """Points (P, 3), encoded colours (P, 3), and per point the views of its track and its pixels there."""
    count, height, width = shown.shape[:3]
    rng = np.random.default_rng(seed)
    share = -(-CANDIDATES // count)
    drawn = [tracer.points(pose, rng.random((share, 2))) for pose in poses]
    points = np.concatenate(drawn)
    points = points[np.isfinite(points).all(axis=1)]
    views: list[list[int]] = [[] for _ in points]
    places: list[list[np.ndarray]] = [[] for _ in points]
    colours: list[list[np.ndarray]] = [[] for _ in points]
    for view in rng.permutation(count):
        pose = poses[view]
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel = np.array([width, height]) / 2 - focal * local[:, :2] / local[:, 2:]
        inside = (local[:, 2] > 0) & (pixel >= 0).all(axis=1) & (pixel < [width, height]).all(axis=1)
        wanted = np.flatnonzero(inside & (np.array([len(v) for v in views]) < POINT_VIEWS))
        if not len(wanted):
            continue
        met = tracer.points(pose, pixel[wanted] / [width, height])
        depth = (met - pose[:3, 3]) @ pose[:3, 2]
        clear = np.abs(depth - local[wanted, 2]) < SAME_PLACE * local[wanted, 2]
        for i in wanted[clear]:
            views[i].append(int(view))
            places[i].append(pixel[i])
            column, row = pixel[i].astype(int)
            colours[i].append(shown[view, row, column])
    kept = [i for i, c in enumerate(colours) if len(c) > 1 and np.std(c, axis=0).max() < SAME_COLOUR]
    mean = np.array([np.mean(colours[i], axis=0) for i in kept]).reshape(-1, 3)
    return points[kept], mean, [np.array(views[i]) for i in kept], [np.array(places[i]) for i in kept]
