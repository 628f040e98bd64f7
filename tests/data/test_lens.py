"""Lens distortion: images of a lens become those of a pinhole, or are refused."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mi_refgs.data.dataset import read_dataset
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import write_png
from tests.helpers import refused
from tests.scenes.dots import dots
from tests.scenes.layouts import change_transforms, write_transforms

WIDTH, HEIGHT = 96, 120
PINHOLE = {"fl_x": 80.0, "fl_y": 84.0, "cx": 50.0, "cy": 57.0}
SIGMA = 1.6  # pixels, of a dot
DOTS = [(x, y) for x in (-0.45, -0.2, 0.0, 0.25, 0.45) for y in (-0.5, -0.25, 0.1, 0.5)]  # image plane

LENSES: dict[str, dict[str, Any]] = {
    "barrel": {"k1": -0.2, "k2": 0.03},
    "pincushion": {"k1": 0.15, "k2": 0.05, "k3": 0.01, "camera_model": "OPENCV"},
    "tangential": {"p1": 0.02, "p2": -0.015},
    "photograph": {"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575},
    "fisheye": {"is_fisheye": True, "k1": 0.05, "k2": -0.02, "k3": 0.003, "k4": -0.001},
    "equidistant": {"camera_model": "OPENCV_FISHEYE", "k1": 0.0},
}


def seen_by(lens: dict[str, Any], x: float, y: float) -> tuple[float, float]:
    """OpenCV's equations for one point, pixels from the top left corner."""
    k1, k2, k3, k4, p1, p2 = (lens.get(key, 0.0) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    r = math.hypot(x, y)
    if lens.get("is_fisheye") or lens.get("camera_model") == "OPENCV_FISHEYE":
        t = math.atan(r)
        factor, dx, dy = (t * (1 + k1 * t**2 + k2 * t**4 + k3 * t**6 + k4 * t**8) / r if r else 1.0), 0.0, 0.0
    else:
        factor = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6
        dx = 2 * p1 * x * y + p2 * (r**2 + 2 * x**2)
        dy = p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y
    x, y = x * factor + dx, y * factor + dy
    return PINHOLE["fl_x"] * x + PINHOLE["cx"], PINHOLE["fl_y"] * y + PINHOLE["cy"]


def dataset(folder: Path, lens: dict[str, Any], alpha: bool = False) -> Path:
    """Two views of dots through a lens, linear, with maps."""
    across, down = np.array([seen_by(lens, x, y) for x, y in DOTS]).T
    image = np.repeat(dots(WIDTH, HEIGHT, across, down, SIGMA)[..., None], 3, axis=-1)
    covered = (image[..., 0] > 0.2).astype(float)
    frames = []
    for name in "ab":
        write_exr(folder / f"{name}.exr", np.dstack([image, image[..., 0]]) if alpha else image)
        write_png(folder / f"{name}.png", np.clip(image, 0, 1))
        frames.append({"file_path": name, "transform_matrix": np.eye(4).tolist()})
    write_exr(folder / "depth.exr", 3 * covered)
    frames[0]["depth_path"] = "depth.exr"
    return write_transforms(folder, frames, **PINHOLE, **lens)


def centroid(image: np.ndarray, u: float, v: float) -> tuple[float, float]:
    """Centre of mass around a pixel, iterated so that the window is centred on what it measures."""
    columns, rows = np.arange(image.shape[1]) + 0.5, np.arange(image.shape[0])[:, None] + 0.5
    for _ in range(20):
        weight = image * (np.hypot(columns - u, rows - v) < 4)
        u, v = (weight * columns).sum() / weight.sum(), (weight * rows).sum() / weight.sum()
    return u, v


@pytest.mark.parametrize("name", LENSES)
def test_undistorted_points_are_those_of_a_pinhole(tmp_path: Path, name: str) -> None:
    """Points of a straight line therefore land on one."""
    view = read_dataset(dataset(tmp_path, LENSES[name]), "train", images="exr").views[0].load()
    assert (view.width, view.height, view.cx, view.cy) == (WIDTH, HEIGHT, PINHOLE["cx"], PINHOLE["cy"])
    assert view.fx / PINHOLE["fl_x"] == pytest.approx(view.fy / PINHOLE["fl_y"])
    image, measured = view.image[..., 0], 0
    for x, y in DOTS:
        u, v = view.fx * x + view.cx, view.fy * y + view.cy
        if 5 < u < WIDTH - 5 and 5 < v < HEIGHT - 5:
            assert math.dist(centroid(image, u, v), (u, v)) < 0.1
            measured += 1
    assert measured >= 12
    low, high = {"barrel": (1, 1), "equidistant": (1, 1), "pincushion": (1.02, 1.2)}.get(name, (1, 2))
    assert low <= view.fx / PINHOLE["fl_x"] <= high


def test_alpha_and_maps_are_undistorted_like_the_image(tmp_path: Path) -> None:
    data = read_dataset(dataset(tmp_path, LENSES["barrel"], alpha=True), "train", images="exr")
    view = data.views[0].load()
    assert view.alpha is not None and view.depth is not None
    np.testing.assert_allclose(view.image[..., 0] - (1 - view.alpha), view.alpha, atol=1e-6)
    for x, y in DOTS:
        u, v = int(view.fx * x + view.cx), int(view.fy * y + view.cy)
        if 5 < u < WIDTH - 5 and 5 < v < HEIGHT - 5:
            assert view.depth[v, u] == pytest.approx(3)
    assert set(np.unique(view.depth.round(5))) == {0, 3}


@pytest.mark.parametrize(
    ("lens", "words"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, ["camera_model: the lens 'EQUIRECTANGULAR'", "undistort"]),
        ({"is_fisheye": "yes"}, ["camera_model"]),
        ({"ftheta_p0": 0.1}, ["ftheta_p0"]),
        ({"k1": 0.1, "k6": 0.1}, ["k6"]),
        ({"k4": 0.1, "camera_model": "full_opencv"}, ["k4", "perspective"]),
        ({"is_fisheye": True, "p1": 0.1}, ["p1", "fisheye"]),
        ({"k1": -5.0}, ["frames[0]", "folds"]),
        ({"k1": 1e9}, ["frames[0]", "half-way"]),
    ],
)
def test_unsupported_lenses_are_refused(tmp_path: Path, lens: dict[str, Any], words: list[str]) -> None:
    change_transforms(dataset(tmp_path, {}), lambda content: content.update(lens))
    refused(lambda: read_dataset(tmp_path, "train", images="exr"), "transforms_train.json: ", *words)
