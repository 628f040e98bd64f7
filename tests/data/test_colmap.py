"""COLMAP's layout, text and binary, as this test writes it: cameras, images, copies, masks, points."""

import shutil
import struct
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from mi_refgs.data.colmap_model import read_cameras, read_images, read_points
from mi_refgs.data.dataset import read_dataset
from mi_refgs.data.lens import Lens
from mi_refgs.data.region import region_of
from mi_refgs.io.images import linear_from_srgb
from tests.helpers import refused
from tests.scenes.dots import COLOURS, POINTS, check
from tests.scenes.layouts import SHOTS, VALUES, WRITERS, write_binary, write_colmap


@pytest.mark.parametrize("kind", WRITERS)
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_colmap_cameras_project_points_onto_images(kind: str, place: str, tmp_path: Path) -> None:
    data = write_colmap(tmp_path, kind, place=place)
    train, test = read_dataset(data, "train"), read_dataset(data, "test")
    assert [view.name for view in test.views] == ["a.png", "i.png"]
    assert [view.name for view in train.views] == [shot.name for shot in SHOTS[1:8]]
    for dataset in (train, test):
        for view in dataset.views:
            shot = next(shot for shot in SHOTS if shot.name == view.name)
            check(view, shot)
            assert view.alpha is None and not view.is_linear_radiance
            np.testing.assert_allclose(view.to_world[:3, 3], shot.camera_to_world[:3, 3], atol=1e-9)
    assert train.points is not None and train.points.colour is not None and not train.notes
    np.testing.assert_allclose(train.points.position, POINTS)
    np.testing.assert_allclose(train.points.colour, linear_from_srgb(COLOURS / 255), atol=1e-6)


LENSES: dict[str, tuple[tuple[float, ...], Lens]] = {
    "SIMPLE_PINHOLE": ((107.0, 50.3, 34.6), Lens(False, ())),
    "SIMPLE_RADIAL": ((107.0, 50.3, 34.6, -0.12), Lens(False, (-0.12,))),
    "RADIAL": ((107.0, 50.3, 34.6, -0.12, 0.05), Lens(False, (-0.12, 0.05))),
    "OPENCV": ((*VALUES, -0.1, 0.04, 0.012, -0.009), Lens(False, (-0.1, 0.04), (0.012, -0.009))),
    "FULL_OPENCV": ((*VALUES, -0.1, 0.04, 0.012, -0.009, 0.02, 0, 0, 0),
                    Lens(False, (-0.1, 0.04, 0.02), (0.012, -0.009))),
    "OPENCV_FISHEYE": ((*VALUES, 0.06, -0.03, 0.01, 0.002), Lens(True, (0.06, -0.03, 0.01, 0.002))),
    "SIMPLE_RADIAL_FISHEYE": ((107.0, 50.3, 34.6, 0.06), Lens(True, (0.06,))),
    "RADIAL_FISHEYE": ((107.0, 50.3, 34.6, 0.06, -0.03), Lens(True, (0.06, -0.03))),
    "FISHEYE": (VALUES, Lens(True, ())),
    "SIMPLE_FISHEYE": ((107.0, 50.3, 34.6), Lens(True, ())),
}  # fmt: skip


@pytest.mark.parametrize("model", LENSES)
@pytest.mark.parametrize("kind", WRITERS)
def test_every_lens_model_is_undistorted(model: str, kind: str, tmp_path: Path) -> None:
    values, lens = LENSES[model]
    focal = (107.0, 107.0) if values[0] == 107.0 else (110.0, 104.0)
    shots = [replace(shot, lens=lens, focal=focal) for shot in SHOTS[:3]]
    views = read_dataset(write_colmap(tmp_path, kind, shots, camera=model, values=values), "train").views
    for view, shot in zip(views, shots[1:], strict=True):
        check(view, shot, tolerance=0.06)


@pytest.mark.parametrize("kind", WRITERS)
def test_unsupported_lens_models_are_refused(kind: str, tmp_path: Path) -> None:
    data = write_colmap(tmp_path, kind, SHOTS[:2], camera="FOV", values=(*VALUES, 0.01))
    refused(lambda: read_dataset(data, "train"), f"cameras.{kind}: camera 7: the lens model", "undistort")
    WRITERS[kind](data / "sparse/0", SHOTS[:2], "FULL_OPENCV", (*VALUES, 0.1, 0, 0, 0, 0, 0.2, 0, 0))
    refused(lambda: read_dataset(data, "train"), "b.png: camera 7: k4, k5, k6:", "undistort")


def test_copies_are_used_without_images(tmp_path: Path) -> None:
    """97 × 73 pixels whose copy has 49 × 37: intrinsics follow the file."""
    shots = [replace(shot, width=97, height=73) for shot in SHOTS[:2]]
    data = write_colmap(tmp_path, shots=shots)
    for shot in shots:
        across, down = 49 / 97, 37 / 73
        small = replace(shot, width=49, height=37, focal=(110 * across, 104 * down))
        replace(small, centre=(50.3 * across, 34.6 * down)).write(data / "images_2")
    assert read_dataset(data, "train", pixels=48 * 36).downscale == 2
    shutil.rmtree(data / "images")
    assert read_dataset(data, "train", pixels=10_000).downscale == 1
    view = read_dataset(data, "train").views[0]
    assert (view.width, view.height) == (49, 37)
    assert (view.fx, view.cy) == pytest.approx((110 * 49 / 97, 34.6 * 37 / 73))
    replace(SHOTS[1], width=72, height=96).write(data / "images_2")  # as turned upright by its EXIF data
    refused(lambda: read_dataset(data, "train"), "72 × 96 pixels are no copy of 97 × 73", "turn it")


def test_unreliable_points_are_left_out(tmp_path: Path) -> None:
    data = write_colmap(tmp_path, "txt")
    rng = np.random.default_rng(0)
    lines = []
    for i in range(150):
        x, y, z = rng.uniform(-1, 1, 3)
        error, views = (5.0, 4) if i < 10 else (0.5, 2 if i < 30 else 3)
        lines.append(f"{i} {x} {y} {z} 1 2 3 {error} {' '.join(f'{v} 0' for v in range(views))}")
    (data / "sparse/0/points3D.txt").write_text("\n".join(lines))
    points = read_dataset(data, "train").points
    assert points is not None and len(points.position) == 120
    (data / "sparse/0/points3D.txt").write_text("\n".join(lines[:50]))
    points = read_dataset(data, "train").points
    assert points is not None and len(points.position) == 50  # few points are better than none
    (data / "sparse/0/points3D.txt").unlink()
    assert read_dataset(data, "train").points is None


def test_cameras_and_images_without_each_other_are_noted(tmp_path: Path) -> None:
    data = write_colmap(tmp_path)
    SHOTS[0].write(data / "images/more")
    (data / "images/c.png").unlink()
    write_binary(data / "sparse/0", [replace(SHOTS[1], name="\u00e9.png"), SHOTS[0], *SHOTS[2:]])
    (data / "images/b.png").rename(data / "images/e\u0301.png")  # the same letter, as macOS writes it
    found = read_dataset(data, "train")
    said = "1 of 9 cameras have no image and are left out; 1 of 9 images have no camera and are left out"
    assert len(found.views) == 7 and "; ".join(found.notes) == said
    shutil.rmtree(data / "images")
    refused(lambda: read_dataset(data, "train"), "images: no such folder")
    (data / "images").mkdir()
    refused(lambda: read_dataset(data, "train"), "images.bin: none of its 9 images is in")


def test_names_outside_of_the_folder_are_not_read(tmp_path: Path) -> None:
    data = write_colmap(tmp_path / "data")
    (data / "images/a.png").rename(tmp_path / "a.png")
    for name in ("../a.png", str(tmp_path / "a.png"), "."):
        write_binary(data / "sparse/0", [replace(SHOTS[0], name=name), *SHOTS[1:]])
        assert read_dataset(data, "test").notes == ("1 of 9 cameras have no image and are left out",)


@pytest.mark.parametrize(
    ("file", "line", "said"),
    [
        ("images", "1 0 0 0 0 0 0 3 7 a.png", "no usable numbers"),
        ("images", "1 nan 0 0 0 0 0 3 7 a.png", "no usable numbers"),
        ("images", "1 1 0 0 0 0 0 3 8 a.png", "there is no camera 8"),
        ("images", "1 1 0 0 0 0 0 3 7", "COLMAP: broken"),
        ("images", "1 1 0 0 0 0 0 3 7 a.png\n\n2 1 0 0 0 0 0 3 7 a.png", "occurs twice"),
        ("images", "1 1 0 0 0 0 0 3 7 a.png\n2 1 0 0 0 0 0 3 7 b.png", "not followed by a line of points"),
        ("cameras", "7 PINHOLE 96 72 1 2 3", "cameras.txt: camera 7: PINHOLE needs 4 numbers"),
        ("cameras", "7 PINHOLE 96 72 -1 2 3 4", "cameras.txt: camera 7: its size and focal length"),
        ("cameras", f"7 PINHOLE {'9' * 5000} 1 1 1 1 1", "cameras.txt: COLMAP: broken"),
        ("cameras", "7 PINHOLE 96 72 1e-10 104 50 34", "focal length: 1e-10 pixels is out of range"),
    ],
)
def test_broken_text_files_are_refused(file: str, line: str, said: str, tmp_path: Path) -> None:
    data = write_colmap(tmp_path, "txt")
    (data / f"sparse/0/{file}.txt").write_text(line)
    refused(lambda: read_dataset(data, "test"), "s.txt:", said)


def test_region_of_both_splits_is_that_of_the_training_cameras(tmp_path: Path) -> None:
    """Also a split of one view, whose camera alone looks at no point, and whose name is written otherwise."""
    data = write_colmap(
        tmp_path, shots=[replace(one, name=one.name.replace("d", "e\u0301")) for one in SHOTS]
    )
    for count in (2, 1):
        train, test = read_dataset(data, "train"), read_dataset(data, "test")
        assert len(test.views) == count and test.region == train.region == region_of(train.views)
        (data / "sparse/0/test.txt").write_text("\ufeff\u00e9.png\n\nmistyped.png\n", "utf-8")
    assert "1 images: named in test.txt, but not in the model, such as mistyped.png" in train.notes


def test_truncated_binary_files_are_refused(tmp_path: Path) -> None:
    """Every length of each file but the whole one is one sentence, at once."""
    model = write_colmap(tmp_path, shots=SHOTS[:3]) / "sparse/0"
    for name, read in (("cameras", read_cameras), ("images", read_images), ("points3D", read_points)):
        path = model / f"{name}.bin"
        whole = path.read_bytes()
        for length in range(0, len(whole), 17):
            path.write_bytes(whole[:length])
            refused(partial(read, path), f"{name}.bin: COLMAP: broken")
        path.write_bytes(whole + b"\0")
        refused(partial(read, path), "1 bytes follow the last record")
        path.write_bytes(struct.pack("<Q", 2**63) + whole[8:])
        began = time.process_time()
        refused(partial(read, path), "are more than the file contains")
        assert time.process_time() - began < 1
        path.write_bytes(whole)
