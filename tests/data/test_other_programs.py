"""Folders as other programs write them: what they mean is read, and what was changed is said."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.data.dataset import read_dataset, reader_of
from mi_refgs.io.images import linear_from_srgb
from tests.helpers import refused
from tests.scenes.dots import COLOURS, POINTS, check
from tests.scenes.layouts import (
    SHOTS,
    change_transforms,
    point_bytes,
    write_colmap,
    write_llff,
    write_nerfstudio,
    write_text,
)

SPARSE = "sparse/0"


def colmap(folder: Path, name: str = "{}", images: str = "images", place: str = SPARSE) -> Path:
    """The model calls the images by another name than the folder."""
    for shot in SHOTS:
        shot.write(folder / images)
    write_text(folder / place, [replace(shot, name=name.format(shot.name)) for shot in SHOTS])
    return folder


def points_beside_colmap(folder: Path) -> None:
    (colmap(folder) / SPARSE / "points3D.txt").unlink()
    (folder / SPARSE / "points3D.ply").write_bytes(point_bytes())


def points_of_nerfstudio(folder: Path) -> None:
    """Poses and points share a frame: `applied_transform` was applied to both."""
    write_nerfstudio(folder, ply_file_path="a.ply", applied_transform=np.eye(4)[[0, 2, 1, 3]][:3].tolist())
    (folder / "a.ply").write_bytes(point_bytes("ascii"))


def frames(change: Callable[[dict[str, Any]], Any], **content: Any) -> Callable[[Path], None]:
    """A transforms.json whose frames were changed."""

    def write(folder: Path) -> None:
        write_nerfstudio(folder, **content)
        change_transforms(folder, lambda made: [change(frame) for frame in made["frames"]])

    return write


def named(name: str) -> Callable[[Path], None]:
    return frames(lambda frame: frame.update(file_path=name.format(frame["file_path"][-5:])))


def turned(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    """Other matrices."""
    key = "transform_matrix"
    return frames(lambda frame: frame.update({key: change(np.array(frame[key])).tolist()}))


def fourfold(frame: dict[str, Any]) -> None:
    frame.update({key: 4 * frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")})


def marked(write: Callable[[Path], Path], pattern: str) -> Callable[[Path], None]:
    """With a byte-order mark, as editors of Windows write."""

    def written(folder: Path) -> None:
        for path in write(folder).glob(pattern):
            path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())

    return written


def letters(folder: Path) -> None:
    for path in (*(colmap(folder) / "images").iterdir(),):
        path.rename(path.with_suffix(".Png"))


def rigs(folder: Path) -> None:
    for name in ("rigs", "frames"):
        (colmap(folder) / SPARSE / f"{name}.bin").write_bytes(b"\x01")


FOLDERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "COLMAP, dense": (lambda f: colmap(f / "dense/0", place="sparse"), ""),
    "COLMAP, two models": (lambda f: write_text(write_colmap(f, place="sparse/1") / SPARSE, SHOTS[:3]),
                           "sparse/1, of 9 images, is read; 1 smaller models are left out"),
    "COLMAP, folder in the names": (lambda f: colmap(f, "images/{}"), ""),
    "COLMAP, other letters": (lambda f: colmap(f, "{:.1}.PNG"), ""),
    "COLMAP, other letters of files": (letters, ""),
    "COLMAP, no endings": (lambda f: colmap(f, "{:.1}"), ""),
    "COLMAP, flat": (lambda f: colmap(f, images="", place=""), ""),
    "COLMAP, distorted": (lambda f: colmap(f, images="input", place="distorted/sparse/0"), ""),
    "COLMAP, spaces": (lambda f: write_colmap(f, "txt", [replace(s, name=f"ü {s.name}") for s in SHOTS]), ""),
    "COLMAP, Windows": (lambda f: colmap(f, "C:\\Users\\me\\vase\\images\\{}"), "9 images: the path"),
    "COLMAP, byte-order mark": (marked(colmap, "sparse/0/*.txt"), ""),
    "COLMAP, rigs": (rigs, ""),
    "COLMAP, points as PLY": (points_beside_colmap, ""),
    "nerfstudio, points as PLY": (points_of_nerfstudio, ""),
    "nerfstudio, scaled": (frames(fourfold), "7 images: focal length and principal point"),
    "nerfstudio, small letters": (frames(lambda frame: frame.update(camera_model="opencv")), ""),
    "nerfstudio, no distortion": (partial(write_nerfstudio, k1=0.0, k4=0.0, p1=0.0, is_fisheye=False), ""),
    "nerfstudio, FULL_OPENCV": (frames(lambda frame: frame.update(camera_model="FULL_OPENCV")), ""),
    "nerfstudio, 3 × 4": (turned(lambda m: m[:3]), ""),
    "nerfstudio, rounded": (turned(lambda m: np.round(m, 3)), "7 images: the rotation is rounded or"),
    "Blender, scaled camera": (turned(lambda m: m @ np.diag([2, 3, 1, 1])), "made orthonormal"),
    "nerfstudio, other letters": (named("images/{:.1}.JPG"), ""),
    "nerfstudio, no endings": (named("images/{:.1}"), ""),
    "nerfstudio, mixed letters": (frames(lambda frame: frame.update(file_path=frame["file_path"][:-4]),
                                         shots=[replace(s, name=f"{s.name[0]}.Png") for s in SHOTS]), ""),
    "nerfstudio, Windows": (named("images\\{}"), ""),
    "instant-ngp, Windows": (named("./..\\scenes\\vase\\images/{}"), "7 images: the path leads"),
    "nerfstudio, absolute": (named("/home/me/vase/images/{}"), "such as '/home/me/vase/images/b.png'"),
    "nerfstudio, copies": (lambda f: (write_nerfstudio(f) / "images").rename(f / "images_4"), "the path"),
    "nerfstudio, byte-order mark": (marked(write_nerfstudio, "*.json"), ""),
}  # fmt: skip


@pytest.mark.parametrize("name", FOLDERS)
def test_folder_of_another_program(name: str, tmp_path: Path) -> None:
    write, said = FOLDERS[name]
    write(tmp_path)
    found = read_dataset(tmp_path, "train")
    assert len(found.views) == 7 and said in " ".join(found.notes) and bool(said) == bool(found.notes)
    for view, shot in zip(found.views, SHOTS[1:], strict=False):
        check(view, shot)
        assert view.file is not None and view.file.lens is None
        np.testing.assert_allclose(view.to_world[:3, 3], shot.camera_to_world[:3, 3], atol=1e-3)
    if "COLMAP" in name or "PLY" in name:
        assert found.points is not None and found.points.colour is not None
        np.testing.assert_allclose(found.points.position, POINTS, atol=1e-6)
        np.testing.assert_allclose(found.points.colour, linear_from_srgb(COLOURS / 255), atol=1e-6)


PLAIN = ("masks/{}.png.png", "masks/{}.mask.png", "masks/{}_mask.png", "masks/{}.jpg", "images/{}_mask.png")


@pytest.mark.parametrize("pattern", [*PLAIN, "images_mask/{}.png", "mask/{}.PNG", "train_mask/{}.png"])
@pytest.mark.parametrize("write", [write_nerfstudio, write_llff, write_colmap])
def test_masks_become_alpha(write: Callable[[Path], Path], pattern: str, tmp_path: Path) -> None:
    """White is the object; all images need one."""
    half = pattern.endswith("_mask.png")
    mask = np.zeros((36, 48) if half else (72, 96), np.uint8)
    mask[len(mask) // 2 :] = 255
    (write(tmp_path) / pattern).parent.mkdir(exist_ok=True)
    for shot in SHOTS:
        Image.fromarray(mask).save(tmp_path / pattern.format(shot.name[0]))
    found = read_dataset(tmp_path, "train", background="black")
    view, notes = found.views[0].load(), " ".join(found.notes)
    assert view.alpha is not None and view.alpha.shape == (72, 96)
    assert view.alpha[:34].max() < 0.02 and view.alpha[38:].min() > 0.98
    assert view.image[:34].max() < 0.02 and view.image[38:].max() > 0.9
    assert ("_mask.png of 48 × 36 for 96 × 72 pixels" in notes) == half
    assert ("7 images: a mask was found" in notes) == (pattern not in PLAIN)
    if not pattern.startswith("images/"):
        (tmp_path / pattern.format("b")).unlink()
        refused(lambda: read_dataset(tmp_path, "train"), f"{pattern.split('/')[0]}/b.png: mask: missing")


def test_masks_of_other_images_are_not_used(tmp_path: Path) -> None:
    """train_mask is not for the images of test, nor masks/a.png for train/a.png."""
    images, masks = write_nerfstudio(tmp_path) / "images", tmp_path / "train_mask"
    shutil.copytree(images, tmp_path / "train")
    shutil.copytree(images, masks)
    assert not read_dataset(tmp_path, "train").has_alpha
    change_transforms(tmp_path, lambda made: made["frames"][1].update(mask_path="train_mask\\b.png"))
    refused(lambda: read_dataset(tmp_path, "train"), "6 of 7 images, such as 'images/c'; give")
    change_transforms(tmp_path, lambda made: made["frames"][1].update(mask_path="images/b.png"))
    refused(lambda: read_dataset(tmp_path, "train"), "frames[1].mask_path: it is the image")
    named("train/{}")(tmp_path)
    assert read_dataset(tmp_path, "train").has_alpha
    masks.rename(tmp_path / "masks")
    refused(lambda: read_dataset(tmp_path, "train"), "masks/train/b.png: mask: missing")
    shutil.rmtree(tmp_path / "masks")
    images.rename(tmp_path / "golden_mask")  # images of a mask
    named("golden_mask/{}")(tmp_path)
    assert not read_dataset(tmp_path, "train").has_alpha


def test_an_image_is_in_one_split(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path)
    change_transforms(tmp_path, lambda made: made["frames"][1].update(file_path="images/a.png"))
    refused(lambda: read_dataset(tmp_path, "train"), "images/a.png: 2 views have this name")


def test_first_layout_that_is_whole_is_read(tmp_path: Path) -> None:
    write_colmap(write_nerfstudio(tmp_path))
    assert reader_of(tmp_path).name.startswith("Blender")
    change_transforms(tmp_path, lambda made: made["frames"][3].update(file_path="images/bb.png"))
    for split in ("train", "test"):  # one reader for both: their worlds may differ
        found = read_dataset(tmp_path, split)
        assert found.views[0].name in ("a.png", "b.png")
        [note] = found.notes
        assert "not read as Blender, NeRF, nerfstudio: " in note and "images/bb.png: file: missing" in note
    (tmp_path / SPARSE / "cameras.bin").write_bytes(b"")
    refused(lambda: read_dataset(tmp_path, "train"), "bb.png", "COLMAP: ", "cameras.bin: COLMAP: broken")


def test_one_file_for_two_images_is_refused(tmp_path: Path) -> None:
    data = colmap(tmp_path)
    write_text(data / SPARSE, [replace(SHOTS[0], name=f"C:\\{i}\\a.png") for i in range(2)])
    refused(lambda: read_dataset(data, "train"), "are both", "restore the folders")
