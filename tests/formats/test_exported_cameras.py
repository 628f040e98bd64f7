"""`--to cameras` of every layout of data sets, read back with the package's own readers."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from mi_refgs.data.dataset import READERS, reader_of
from mi_refgs.data.lens import Lens
from mi_refgs.fitting.runner import load_method
from mi_refgs.formats import Shot
from mi_refgs.formats.cameras import write as write_cameras
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import read_png, write_png
from mi_refgs.reconstruction.provenance import Provenance
from mi_refgs.runs.trained_scene import TrainedScene
from tests.helpers import read_loaded
from tests.scenes import layouts
from tests.scenes.layouts import SHOTS
from tests.scenes.tiny import write_data

JPEGS = [replace(shot, name=f"{shot.index}/{shot.name[0]}.JPG") for shot in SHOTS]
BENT = Lens(False, (0.05, -0.02, 0.01), (1e-3, -2e-3))
FISHEYE = Lens(True, (0.05, -0.02, 0.0, 0.0))


def nerfstudio(folder: Path, lens: Lens = BENT) -> Path:
    """JPEG files, each with its own focal length, behind one kind of lens; one test view is named."""
    shots = [replace(shot, focal=(110.0 + shot.index, 104.0), lens=lens) for shot in JPEGS]
    given: dict[str, Any] = dict(zip(("k1", "k2", "k3", "k4")[: len(lens.radial)], lens.radial, strict=True))
    given |= {} if lens.fisheye else dict(zip(("p1", "p2"), lens.tangential, strict=True))
    given |= {"camera_model": "OPENCV_FISHEYE" if lens.fisheye else "OPENCV"}
    return layouts.write_nerfstudio(folder, shots, test_filenames=["images/3/d.JPG"], **given)


def masked(folder: Path) -> Path:
    """Frames that name masks."""
    data = nerfstudio(folder)
    write_png(data / "mask.png", np.indices((72, 96)).sum(axis=0)[..., None].repeat(3, -1) % 2)
    layouts.change_transforms(data, lambda made: [f.update(mask_path="mask.png") for f in made["frames"]])
    return data


def colmap(folder: Path, camera: str, values: tuple[float, ...]) -> Path:
    return layouts.write_colmap(folder, shots=JPEGS, camera=camera, values=values)


def llff(folder: Path, masks: bool = False) -> Path:
    data = layouts.write_llff(folder)
    if masks:
        shutil.copytree(data / "images", data / "masks")
    return data


PINHOLE, FULL = (110.0, 104.0, 50.3, 34.6), (0.05, -0.02, 1e-3, 0, 0.01, 0, 0, 0)
NERF, COLMAP, LLFF, NERO = "Blender, NeRF, nerfstudio", "COLMAP", "LLFF", "NeRO Glossy Synthetic"
CASES: dict[str, tuple[str, Callable[[Path], Path]]] = {
    "blender": (NERF, lambda folder: write_data(folder / "ball", truth=False)),
    "exr": (NERF, lambda folder: write_exr_data(folder / "ball")),
    "perspective": (NERF, nerfstudio),
    "fisheye": (NERF, lambda folder: nerfstudio(folder, FISHEYE)),
    "masked": (NERF, masked),
    "pinhole": (COLMAP, lambda folder: colmap(folder, "PINHOLE", PINHOLE)),
    "opencv": (COLMAP, lambda folder: colmap(folder, "OPENCV", (*PINHOLE, 0.05, -0.02, 1e-3, -2e-3))),
    "full": (COLMAP, lambda folder: colmap(folder, "FULL_OPENCV", (*PINHOLE, *FULL))),
    "fisheyes": (COLMAP, lambda folder: colmap(folder, "OPENCV_FISHEYE", (*PINHOLE, 0.05, -0.02, 0, 0))),
    "plain": (LLFF, llff),
    "masks": (LLFF, lambda folder: llff(folder, True)),
    "depths": (NERO, layouts.write_glossy),
}
"""The reader of each way to write a data set; a new reader adds its own."""
CAMERA_FILES = ("transforms*.json", "poses_bounds.npy", "*-camera.pkl", "sparse")


def write_exr_data(folder: Path) -> Path:
    """The tiny data set with EXR files beside the PNG files."""
    data = write_data(folder, truth=False)
    for path in data.glob("*/*.png"):
        write_exr(path.with_suffix(".exr"), read_png(path))
    return data


def test_every_reader_has_a_layout() -> None:
    assert {*READERS} == {reader for reader, _ in CASES.values()}


@pytest.mark.parametrize("kind", CASES)
def test_exported_cameras_match_the_image_files(kind: str, tmp_path: Path) -> None:
    """Read back beside the image files: the same images and cameras, whatever size the fit read them at."""
    reader, write = CASES[kind]
    data = write(tmp_path if kind in ("blender", "exr") else tmp_path / "data")
    assert reader_of(data).name == reader
    images = "exr" if kind == "exr" else "png"
    method = load_method(None, "quick", ["data.downscale=2", f"data.images='{images}'"])
    trained, out = cast(TrainedScene, None), tmp_path / "out"
    write_cameras(trained, out, Provenance(method, data).shots(trained, "test", "train"))
    names = [f.split()[-1] for f in (out / "sparse/0/images.txt").read_text().splitlines()[1::2]]
    below = data / "images" if (data / "images").is_dir() else data
    assert names and all((below / name).is_file() for name in names)
    for source in ("transforms.json", "sparse"):
        if images == "exr" and source == "sparse":
            continue  # our reader of COLMAP takes no EXR
        again = tmp_path / source.replace(".", "_")
        into = again / "images" if source == "sparse" and kind == "blender" else again
        shutil.copytree(data, into, ignore=shutil.ignore_patterns(*CAMERA_FILES))
        (shutil.copytree if source == "sparse" else shutil.copy)(out / source, again / source)
        for split, read_at in (("test", 1), ("train", 2)):
            options: dict[str, Any] = {"downscale": read_at, "images": images, "truth": False}
            before, after = (read_loaded(folder, split, **options) for folder in (data, again))
            assert len(before.views) == len(after.views)
            for view, other in zip(before.views, after.views, strict=True):
                np.testing.assert_allclose(other.to_world, view.to_world, atol=1e-6)
                for name in ("width", "height", "fx", "fy", "cx", "cy"):
                    assert getattr(other, name) == pytest.approx(getattr(view, name), rel=1e-6)
                assert source == "sparse" or kind == "depths" or (view.alpha is None) == (other.alpha is None)
                if view.alpha is None or other.alpha is not None:
                    np.testing.assert_allclose(other.image, view.image, atol=1e-5)
                # Depth as a mask has no name in other layouts, and COLMAP's masks lie in a folder of theirs.
                assert (other.alpha is None) == (view.alpha is None) or kind in ("depths", "masked")


def test_cameras_without_image_files_are_named(tmp_path: Path) -> None:
    """Such as those of a reader that gives arrays, and those around a run without data."""
    camera = read_loaded(write_data(tmp_path / "ball", views=1, truth=False), "train").views[0].camera()
    shots = [Shot("a.jpg", "test", camera), Shot("train/r_0", "train", camera)]
    write_cameras(cast(TrainedScene, None), tmp_path, shots)
    content = json.loads((tmp_path / "transforms.json").read_text())
    assert [frame["file_path"] for frame in content["frames"]] == ["a.jpg", "train/r_0.png"]
