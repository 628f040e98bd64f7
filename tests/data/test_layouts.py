"""Layouts of data sets as this test writes them: nerfstudio, Shiny Blender, LLFF, NeRO's Glossy Synthetic."""

import pickle
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.data.dataset import read_dataset
from mi_refgs.io.images import write_png
from tests.helpers import refused
from tests.scenes import layouts
from tests.scenes.dots import check
from tests.scenes.layouts import SHOTS, change_transforms, write_glossy, write_llff


def test_filenames_define_splits(tmp_path: Path) -> None:
    data = layouts.write_nerfstudio(tmp_path, test_filenames=["images/c.png"], val_filenames=["images/d.png"])
    names = {split: [v.name for v in read_dataset(data, split).views] for split in ("train", "test")}
    assert names["test"] == ["images/c"] and len(names["train"]) == 7
    change_transforms(data, lambda content: content.update(train_filenames=["images/a.png", "images/b.png"]))
    assert [v.name for v in read_dataset(data, "train").views] == ["images/a", "images/b"]
    change_transforms(data, lambda content: content.update(test_filenames=["./images/c.png"]))
    change_transforms(data, lambda content: content["frames"][2].update(fl_x=None))  # as if it were not there
    assert [v.name for v in read_dataset(data, "test").views] == ["images/c"]
    change_transforms(data, lambda content: [content.pop(f"{split}_filenames") for split in ("test", "val")])
    for split, listed in (("train", "images/b"), ("test", "images/a")):  # held out of those that are listed
        assert [v.name for v in read_dataset(data, split).views] == [listed]
    for names_given, words in ((["no.png"], "1 path of no frame"), ([3], "not a list of paths")):
        change_transforms(data, partial(dict.update, test_filenames=names_given))
        refused(partial(read_dataset, data, "test"), words)


def shiny(folder: Path, alpha: bool = True) -> Path:
    """A disc whose normals and depths vary, with nothing around it."""
    y, x = np.mgrid[:24, :32]
    inside = (x - 15.5) ** 2 + (y - 11.5) ** 2 < 80
    normal = np.stack([x / 32 - 0.5, y / 24 - 0.5, np.ones_like(x)], axis=-1)
    normal = np.where(inside[..., None], normal / np.linalg.norm(normal, axis=-1, keepdims=True), 0)
    disparity = np.where(inside, 1 / (1 + 3 + 0.1 * x), 0).astype(np.float32)
    (folder / "test").mkdir()
    rgba = np.concatenate([np.full((24, 32, 3), 0.5), inside[..., None]], axis=-1)
    write_png(folder / "test/r_0.png", rgba if alpha else rgba[..., :3])
    write_png(folder / "test/r_0_normal.png", 0.5 * normal + 0.5)
    Image.fromarray(disparity).save(folder / "test/r_0_disp.tiff")
    if not alpha:
        write_png(folder / "test/r_0_alpha.png", np.repeat(inside[..., None], 3, axis=-1))
    frame = {"file_path": "test/r_0", "transform_matrix": SHOTS[0].camera_to_world.tolist()}
    return layouts.write_transforms(folder, [frame], camera_angle_x=0.7)


@pytest.mark.parametrize("alpha", [True, False])
def test_shiny_blender_maps_are_read(alpha: bool, tmp_path: Path) -> None:
    data = shiny(tmp_path, alpha)
    view = read_dataset(data, "test").views[0].load()
    assert view.normal is not None and view.depth is not None and view.alpha is not None
    inside = view.alpha > 0
    assert 240 < inside.sum() < 260 and (view.alpha[inside] == 1).all()
    length = np.linalg.norm(view.normal, axis=-1)
    np.testing.assert_allclose(length[inside], 1, atol=1e-6)
    assert not length[~inside].any() and not view.depth[~inside].any()
    row, column = 12, 20
    expected = np.array([column / 32 - 0.5, row / 24 - 0.5, 1])
    np.testing.assert_allclose(view.normal[row, column], expected / np.linalg.norm(expected), atol=6e-3)
    assert view.depth[row, column] == pytest.approx(3 + 0.1 * column, rel=1e-5)
    half = read_dataset(data, "test", downscale=2).views[0].load()
    assert half.depth is not None and half.normal is not None and half.normal.shape == (12, 16, 3)
    assert half.depth[6, 10] == pytest.approx(3 + 0.1 * 20.5, rel=1e-5)
    assert read_dataset(data, "test", truth=False).views[0].normal is None


def test_shiny_blender_disparity_formats(tmp_path: Path) -> None:
    data = shiny(tmp_path)
    file = data / "test/r_0_disp.tiff"
    Image.fromarray(np.full((24, 32), 65535 // 4, dtype=np.uint16)).save(file)
    depth = read_dataset(data, "test").views[0].depth
    assert depth is not None and depth[3, 3] == pytest.approx(3, abs=1e-3)
    Image.fromarray(np.full((20, 32), 65535 // 4, dtype=np.uint16)).save(file)
    refused(lambda: read_dataset(data, "test"), "r_0_disp.tiff: size: 32 × 20 pixels")
    Image.fromarray(np.zeros((24, 32, 3), dtype=np.uint8)).save(file)
    refused(lambda: read_dataset(data, "test"), "r_0_disp.tiff: pixels: not one channel")


@pytest.mark.parametrize("factor", [1, 4])
def test_llff_cameras_project_points_onto_images(factor: int, tmp_path: Path) -> None:
    data = write_llff(tmp_path, factor)  # focal lengths are those of the original images, however large
    train, test = read_dataset(data, "train"), read_dataset(data, "test")
    assert (len(train.views), [view.name for view in test.views]) == (7, ["a.png", "i.png"])
    for view in train.views:
        shot = next(shot for shot in SHOTS if shot.name == view.name)
        check(view, replace(shot, focal=(107.0, 107.0), centre=(48.0, 36.0)))
    view = read_dataset(data, "train", downscale=4).views[0].load()
    assert view.width == 24 and view.fx == pytest.approx(107 / 4)
    assert read_dataset(data, "train", pixels=2000).downscale == 2


def test_broken_llff_poses_are_refused(tmp_path: Path) -> None:
    data = write_llff(tmp_path)
    path = data / "poses_bounds.npy"
    good, whole = np.load(path), path.read_bytes()
    huge = whole.replace(b"(9, 17)", b"(10000000000, 17)").replace(b" " * 10, b"", 1)
    for content in (huge, *(whole[:length] for length in range(0, len(whole), 101))):
        path.write_bytes(content)
        refused(partial(read_dataset, data, "train"), "poses_bounds.npy: NumPy")
    infinite, sheared, flat = good.copy(), good.copy(), good.copy()
    infinite[3, 2], sheared[1, 0], flat[1, 14] = np.inf, 7, 0
    for array, said in (
        (np.array([Code()], dtype=object), "NumPy: cannot be read"),
        (good[:, :15], "shape (9, 15)"),
        (good[:8], "8 cameras, but images has 9 images"),
        (infinite, "infinite"),
        (sheared, "b.png: not a rotation"),
        (flat, "b.png: height, width and focal length"),
    ):
        np.save(path, array, allow_pickle=True)
        refused(partial(read_dataset, data, "train"), said)


class Code:
    """Pickled, it runs code when it is read."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (exec, ("raise SystemExit('code was run')",))


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_glossy_synthetic_is_read(protocol: int, tmp_path: Path) -> None:
    """The pose is stored by rows, K by columns."""
    data = write_glossy(tmp_path, protocol)
    train, test = read_dataset(data, "train"), read_dataset(data, "test")
    assert [v.name for v in train.views] == [*"1234567"] and [v.name for v in test.views] == ["0", "8"]
    view = test.views[0].load()
    assert view.alpha is not None and view.depth is not None
    expected = np.repeat([[0.0] * 32 + [1.0] * 32 + [0.0] * 32], 72, axis=0)
    np.testing.assert_array_equal(view.alpha, expected)
    np.testing.assert_allclose(view.depth, 3 * expected, atol=2e-4)
    shot = SHOTS[0]
    np.testing.assert_allclose(view.to_world[:3, 3], shot.camera_to_world[:3, 3], atol=1e-6)
    for path in data.glob("*-depth.png"):
        Image.fromarray(np.zeros((72, 96), dtype=np.uint16)).save(path)
    for view, shot in zip(read_dataset(data, "train").views, SHOTS[1:8], strict=True):
        check(view, shot)


def test_hostile_pickles_are_refused(tmp_path: Path) -> None:
    """Nothing in them is run, and a file without the arrays of a camera is refused."""
    data, path, array = write_glossy(tmp_path), tmp_path / "1-camera.pkl", np.eye(3)
    good = path.read_bytes()
    hostile = {
        "code": pickle.dumps([Code(), array]),
        "object array": pickle.dumps([np.array([Code()], dtype=object)]),
        "big-endian": pickle.dumps([np.eye(4)[:3].astype(">f8"), array]),
        "huge memo": b"\x80\x04]r\xff\xff\xff\xff.",
        "huge bytes": b"\x80\x05\x96" + (2**40).to_bytes(8, "little") + b"a.",
        "long": pickle.dumps([np.zeros(20_000)]),
        "other shape": pickle.dumps([np.eye(4)[:, :3], array]),
        "empty": b"",
    } | {f"cut at {i}": good[:i] for i in range(0, len(good) - 9, 40)}
    for content in hostile.values():
        path.write_bytes(content)
        refused(partial(read_dataset, data, "train"), "1-camera.pkl: pickle: ")
    path.write_bytes(pickle.dumps([np.full((3, 4), np.nan), array]))
    refused(partial(read_dataset, data, "train"), "1-camera.pkl: pose: not a rotation")
    for matrix in (np.zeros((3, 3)), np.diag([np.inf, 1, 1]), np.diag([1.0, 1, 2])):
        path.write_bytes(pickle.dumps([np.eye(4)[:3], matrix]))
        refused(partial(read_dataset, data, "train"), "1-camera.pkl: K: no matrix")
    path.write_bytes(good[:-2] + pickle.dumps(Code())[2:])  # after the arrays; it would run if it were loaded
    assert len(read_dataset(data, "train").views) == 7
    (data / "0-depth.png").unlink()
    refused(lambda: read_dataset(data, "test"), "0-depth.png: file: missing")
