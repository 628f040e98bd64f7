"""The reader of multi-view data sets: conventions, compositing, intrinsics, what it says about bad input."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from mi_refgs.data.dataset import read_dataset
from mi_refgs.io.exr import read_exr_image, write_exr
from mi_refgs.io.images import box_downscale, write_png
from tests.helpers import read_loaded, refused, unit
from tests.scenes.layouts import change_transforms

ANGLE = 0.7  # camera_angle_x, radians
WIDTH, HEIGHT = 6, 4


def pose(azimuth: float) -> np.ndarray:
    """OpenGL camera-to-world matrix 3 from (0.1, 0.2, 0.3), 20° above the horizon, z up."""
    focus = np.array([0.1, 0.2, 0.3])
    low = math.cos(0.35)
    backward = np.array([math.cos(azimuth) * low, math.sin(azimuth) * low, math.sin(0.35)])
    right = unit(np.cross([0, 0, 1], backward))
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(backward, right), backward, focus + 3 * backward], axis=1)
    return matrix


@pytest.fixture
def folder(tmp_path: Path, rng: np.random.Generator) -> Path:
    """Eight training and two test views of random RGBA pixels, PNG and EXR."""
    for split, count in (("train", 8), ("test", 2)):
        (tmp_path / split).mkdir()
        frames = []
        for i in range(count):
            rgba = rng.random((HEIGHT, WIDTH, 4))
            write_png(tmp_path / split / f"r_{i}.png", rgba)
            rgba[..., :3] *= 3 * rgba[..., 3:]
            write_exr(tmp_path / split / f"r_{i}.exr", rgba)
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose(0.7 * i).tolist()})
        content = json.dumps({"camera_angle_x": ANGLE, "frames": frames})
        (tmp_path / f"transforms_{split}.json").write_text(content)
    return tmp_path


def test_png_is_composited_as_displayed(folder: Path) -> None:
    for background, value in (("white", 1), ("black", 0)):
        data = read_loaded(folder, "train", background=background)
        pixels = np.asarray(Image.open(folder / "train/r_3.png")) / 255
        expected = pixels[..., 3:] * pixels[..., :3] + (1 - pixels[..., 3:]) * value
        view = data.views[3]
        assert (view.name, view.width, view.height) == ("train/r_3", WIDTH, HEIGHT)
        assert not view.is_linear_radiance and view.image.dtype == np.float32 and view.alpha is not None
        np.testing.assert_allclose(view.image, expected, atol=1e-6)
        np.testing.assert_allclose(view.alpha, pixels[..., 3], atol=1e-6)
        np.testing.assert_array_equal(data.background, np.full(3, value, np.float32))


def test_exr_is_linear_and_premultiplied(folder: Path) -> None:
    """Where there are no other files, it is read unasked, and that is said."""
    view = read_loaded(folder, "train", images="exr").views[2]
    pixels = read_exr_image(folder / "train/r_2.exr")
    assert view.is_linear_radiance and view.image.max() > 1
    np.testing.assert_allclose(view.image, pixels[..., :3] + 1 - pixels[..., 3:], atol=1e-6)
    for path in folder.glob("*/*.png"):
        path.unlink()
    alone = read_loaded(folder, "train")
    assert alone.is_linear_radiance and "EXR files" in alone.notes[-1]
    np.testing.assert_array_equal(alone.views[2].image, view.image)


def test_downscale_averages_composited_pixels(folder: Path) -> None:
    for images in ("png", "exr"):
        full = read_loaded(folder, "train", images=images).views[1]
        half = read_loaded(folder, "train", images=images, downscale=2).views[1]
        np.testing.assert_allclose(half.image, box_downscale(full.image, 2), atol=1e-6)
        assert (half.width, half.height) == (WIDTH // 2, HEIGHT // 2)
        assert half.fx == full.fx / 2 and half.cy == full.cy / 2


def test_images_meet_pixel_budget(folder: Path) -> None:
    """Photographs of 1080 × 1920 and their like, read no larger than asked for."""
    Image.new("RGB", (1080, 1920)).save(folder / "large.jpg")
    write_exr(folder / "large.exr", np.zeros((30, 21, 3)))
    frame = {"file_path": "large.jpg", "transform_matrix": pose(0).tolist()}
    change_transforms(folder, lambda content: content.update(frames=[frame]), "train")
    for pixels, factor in ((65536, 6), (1080 * 1920, 1), (1080 * 1920 - 1, 2), (1, 961)):
        assert read_dataset(folder, "train", pixels=pixels).downscale == factor
    assert read_dataset(folder, "train", pixels=70, images="exr").downscale == 3
    view = read_loaded(folder, "train", downscale=7).views[0]
    assert (view.width, view.height) == (1080 // 7, 1920 // 7)
    assert view.cx == pytest.approx(1080 / 2 / 7) and view.cy == pytest.approx(1920 / 2 / 7)


def test_camera_frame_is_that_of_mitsuba(folder: Path) -> None:
    """Mitsuba's frame: +z forward, +x left, +y up; what lies right of the axis lands right."""
    view = read_loaded(folder, "train").views[1]
    opengl = pose(0.7)
    np.testing.assert_allclose(view.to_world[:3], opengl[:3] * [-1, 1, -1, 1])
    focus = np.array([0.1, 0.2, 0.3])
    points = np.stack([focus, focus + 0.3 * opengl[:3, 0] + 0.6 * opengl[:3, 1]])
    camera, focal = view.camera(), 0.5 * WIDTH / math.tan(ANGLE / 2)
    local = camera.to_camera(mi.Point3f(points.T.astype(np.float32)))
    pixels = [camera.fx * local.x / local.z + camera.cx, camera.fy * local.y / local.z + camera.cy]
    expected = WIDTH / 2 + np.array([0, 0.1 * focal]), HEIGHT / 2 - np.array([0, 0.2 * focal])
    np.testing.assert_allclose(np.array(pixels), expected, atol=1e-4)


def test_scene_extent_is_that_of_3dgs(folder: Path) -> None:
    data = read_loaded(folder, "train")
    origins = np.array([pose(0.7 * i)[:3, 3] for i in range(8)])
    extent = 1.1 * max(np.linalg.norm(origins - origins.mean(axis=0), axis=1))
    assert data.scene_extent == pytest.approx(extent)
    lone = replace(data, views=data.views[:1])
    assert lone.scene_extent == pytest.approx(1.1 * np.linalg.norm(pose(0)[:3, 3]))


def test_holdout_without_a_test_file(folder: Path) -> None:
    more = [{"file_path": f"./test/r_{i}", "transform_matrix": pose(i).tolist()} for i in range(2)]
    edit(lambda content: content["frames"].extend(more))(folder)
    (folder / "transforms_test.json").rename(folder / "transforms_val.json")
    assert len(read_loaded(folder, "test").views) == 2 and len(read_loaded(folder, "train").views) == 10
    (folder / "transforms_val.json").unlink()
    names = {split: [v.name for v in read_loaded(folder, split).views] for split in ("train", "test")}
    assert names["test"] == ["test/r_0", "train/r_6"]  # sorted: test/r_0, test/r_1, train/r_0 … train/r_7
    assert len(names["train"]) == 8 and not set(names["train"]) & set(names["test"])
    (folder / "transforms_train.json").rename(folder / "transforms.json")
    assert [v.name for v in read_loaded(folder, "test").views] == names["test"]


def test_ground_truth_maps(folder: Path, rng: np.random.Generator) -> None:
    normal = rng.normal(size=(HEIGHT, WIDTH, 3))
    normal[:2, :3] = 0
    depth = np.where(np.any(normal != 0, axis=-1), 2.0 + np.arange(WIDTH), 0)
    write_exr(folder / "n.exr", normal, names="XYZ")
    write_exr(folder / "d.exr", depth)
    write_exr(folder / "environment.exr", np.ones((2, 4, 3)))
    edit(lambda content: content["frames"][0].update(normal_path="n.exr", depth_path="d.exr"))(folder)
    data = read_loaded(folder, "train", downscale=2)
    assert data.environment == folder / "environment.exr"
    view = data.views[0]
    assert view.normal is not None and view.depth is not None and data.views[1].normal is None
    np.testing.assert_allclose(np.linalg.norm(view.normal, axis=-1), [[0, 1, 1], [1, 1, 1]], atol=1e-6)
    # The block half off the object takes the mean of its other half, column 3 alone.
    np.testing.assert_allclose(view.depth, [[0, 5, 6.5], [2.5, 4.5, 6.5]])
    assert read_loaded(folder, "train", truth=False).views[0].normal is None


def edit(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    """Damage to the training file's content."""
    return lambda folder: change_transforms(folder, change, "train")


def named(key: str, value: Any) -> Callable[[Path], None]:
    """Another value of a key of the first frame."""
    return edit(lambda content: content["frames"][0].update({key: value}))


def resize(folder: Path) -> None:
    """One image more than there may be sizes."""
    for i in range(1, 6):
        write_png(folder / f"train/r_{i}.png", np.ones((HEIGHT, WIDTH + i, 4)))


def nan(folder: Path) -> None:
    broken = np.ones((HEIGHT, WIDTH, 4))
    broken[1, 2, 0] = np.nan
    write_exr(folder / "train/r_4.exr", broken)


def unbounded(folder: Path) -> None:
    write_exr(folder / "train/r_4.exr", np.full((HEIGHT, WIDTH, 4), 1.5))


@pytest.mark.parametrize(
    ("damage", "options", "words"),
    [
        (lambda f: (f / "transforms_train.json").unlink(), {}, ["transforms_train.json", "missing"]),
        (lambda f: (f / "transforms_train.json").write_text("{"), {}, ["transforms_train.json", "JSON"]),
        (edit(lambda c: c.pop("frames")), {}, ["frames", "missing"]),
        (edit(lambda c: c.update(frames=[])), {}, ["zero train views"]),
        (edit(lambda c: c.pop("camera_angle_x")), {}, ["camera_angle_x", "fl_x"]),
        (edit(lambda c: c.update(camera_angle_x="wide")), {}, ["camera_angle_x", "'wide'"]),
        (edit(lambda c: c["frames"][1].pop("file_path")), {}, ["frames[1].file_path"]),
        (named("file_path", "train/none"), {}, ["none.png", "missing"]),
        (named("file_path", "train/r_1.png"), {}, ["train/r_1: 2 views have this name", "rename"]),
        (lambda f: (f / "train/r_0.png").unlink(), {}, ["images: no EXR file", "alike"]),
        (edit(lambda c: c["frames"][1].pop("transform_matrix")), {}, ["frames[1].transform_matrix", "4 × 4"]),
        (named("transform_matrix", np.diag([1.0, 1, -2, 1]).tolist()), {}, ["mirroring"]),
        (named("depth_path", "train/r_1.exr"), {}, ["[0].depth_path", "size"]),
        (named("file_path", "../r_0.png"), {}, ["frames[0].file_path", "'../r_0.png'", "folder"]),
        (named("file_path", "/etc/passwd"), {}, ["frames[0].file_path", "folder"]),
        (named("file_path", "\ud800"), {}, ["missing"]),
        (named("cx", math.inf), {}, ["cx", "inf"]),
        (lambda f: (f / "train/r_0.png").write_bytes(b"\x89PNG"), {}, ["r_0.png", "readable"]),
        (resize, {}, ["6 different sizes", "one size"]),
        (nan, {"images": "exr"}, ["r_4.exr", "NaN", "row 1, column 2"]),
        (unbounded, {"images": "exr"}, ["r_4.exr", "A", "beyond 0 … 1", "export alpha"]),
        (lambda f: None, {"downscale": 5}, ["r_0.png", "downscale", "smaller"]),
        (lambda f: None, {"downscale": 0}, ["downscale"]),
        (lambda f: None, {"background": "green"}, ["background", "green"]),
        (lambda f: None, {"images": "tiff"}, ["images", "tiff"]),
    ],
)
def test_bad_input_names_file_field_and_remedy(
    folder: Path, damage: Callable[[Path], Any], options: dict[str, Any], words: list[str]
) -> None:
    damage(folder)
    message = refused(lambda: read_loaded(folder, "train", **options), *words)
    assert message.startswith(str(folder)) and "\n" not in message.partition(" ← ")[0]


def test_averaged_view_shows_the_same_points(folder: Path) -> None:
    """Pixels are means of blocks, and a point lands in the block of its pixel."""
    view = read_loaded(folder, "train").views[0]
    small = view.averaged(2)
    assert (small.width, small.height) == (WIDTH // 2, HEIGHT // 2)
    np.testing.assert_allclose(small.image[1, 2], view.image[2:4, 4:6].mean(axis=(0, 1)), atol=1e-6)
    assert small.alpha is not None and view.alpha is not None
    np.testing.assert_allclose(small.alpha[0, 1], view.alpha[:2, 2:4].mean(), atol=1e-6)
    points = np.array([[0.1, 0.2, 0.3], [0.3, 0.1, 0.2]])
    row, column, _ = view.project(points)
    less, lesser, _ = small.project(points)
    # Indices are integers at pixel centres.
    np.testing.assert_allclose([(row + 0.5) / 2 - 0.5, (column + 0.5) / 2 - 0.5], [less, lesser], atol=1e-9)
    assert view.averaged(4).image.shape == (1, 1, 3)
    refused(lambda: view.averaged(5), "data.coarse: 6 × 4 pixels are less than a block of 5²")
