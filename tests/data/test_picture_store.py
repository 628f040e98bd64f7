"""Pictures in memory: decoded when they are asked for, no other than those of the file, and bounded."""

from __future__ import annotations

import dataclasses
import gc
import json
import subprocess
import sys
import threading
import weakref
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.data import picture_store
from mi_refgs.data.dataset import View, read_dataset
from mi_refgs.data.picture_files import Mask, PictureFile
from mi_refgs.data.picture_store import Picture, PictureStore
from mi_refgs.errors import InputError
from mi_refgs.fitting.objective import Target
from mi_refgs.fitting.targets import PIXEL_BYTES, Targets
from mi_refgs.io.exr import write_exr
from mi_refgs.io.images import write_png
from mi_refgs.methods.method import CoarsePictures, DataOptions
from tests.helpers import ROOT
from tests.scenes.highlight import ball

VIEWS, WIDTH, HEIGHT = 24, 2000, 1500


def files(folder: Path, rng: np.random.Generator) -> dict[str, PictureFile]:
    """A file of every kind: with alpha or without, read as it is or averaged, masked, linear."""
    for name, channels in (("rgb", 3), ("rgba", 4)):
        write_png(folder / f"{name}.png", rng.random((12, 16, channels)))
        write_exr(folder / f"{name}.exr", rng.random((12, 16, channels)).astype(np.float32))
    Image.fromarray(rng.integers(0, 255, (12, 16), dtype=np.uint8)).save(folder / "mask.png")
    found = {
        name: PictureFile.find(folder / name, 1) for name in ("rgb.png", "rgba.png", "rgb.exr", "rgba.exr")
    }
    found["averaged"] = PictureFile.find(folder / "rgba.png", 2)
    found["masked"] = PictureFile.find(folder / "rgb.png", 1, Mask(folder / "mask.png"))
    return found


@pytest.mark.parametrize("budget", [0, 1 << 20])
def test_a_picture_is_the_same_however_often_it_is_decoded(
    budget: int, tmp_path: Path, rng: np.random.Generator
) -> None:
    """Kept or not; alpha is told without decoding, and 8 bits are kept where the view shows them."""
    store = PictureStore(budget)
    for name, file in files(tmp_path, rng).items():
        picture = Picture(file, 0.75, store)
        expected, opacity = file.read(0.75)
        assert (
            picture.has_alpha
            == (opacity is not None)
            == (name in ("rgba.png", "rgba.exr", "averaged", "masked"))
        )
        for _ in range(2):
            image, alpha = picture.planes()
            assert np.array_equal(image, expected) and image.dtype == np.float32
            assert (alpha is None) == (opacity is None)
            assert alpha is None or opacity is None or np.array_equal(alpha, opacity)
            image[:] = 0  # the caller's own
        assert store.pixels(picture).dtype == (np.uint8 if name in ("rgb.png", "rgba.png") else np.float32)
        assert file.largest >= store.pixels(picture).nbytes
        assert weakref.getweakrefcount(picture) == 1  # however often it was decoded
    assert store.bytes <= budget


def test_what_was_asked_for_last_is_kept(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    decoded, real = [], PictureFile.decode

    def decode(file: PictureFile) -> np.ndarray:
        decoded.append(file.path.stem)
        return real(file)

    monkeypatch.setattr(PictureFile, "decode", decode)
    for name in "abc":
        write_png(tmp_path / f"{name}.png", rng.random((10, 10, 4)))
    store = PictureStore(2 * 400)
    pictures = {name: Picture(PictureFile.find(tmp_path / f"{name}.png", 1), 0.0, store) for name in "abc"}
    assert decoded == ["a", "b"]  # while there was room
    for name in "abacabc":
        pictures[name].planes()
    assert decoded == ["a", "b", "c", "b", "c"] and store.bytes == 800
    del pictures["c"], pictures["b"]
    gc.collect()
    assert store.bytes == 0
    pictures["a"].planes()
    assert store.bytes == 400


def test_a_broken_file_is_told_when_it_is_read_or_when_it_is_needed(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    write_png(tmp_path / "a.png", rng.random((40, 40, 3)))
    (tmp_path / "a.png").write_bytes((tmp_path / "a.png").read_bytes()[:2000])
    file = PictureFile.find(tmp_path / "a.png", 1)
    with pytest.raises(InputError, match=r"a\.png: pixels: not a readable image"):
        Picture(file, 0.0, PictureStore())
    late = Picture(file, 0.0, PictureStore(0))
    with pytest.raises(InputError, match=r"a\.png: pixels: not a readable image"):
        late.planes()


def photographs(folder: Path, rng: np.random.Generator) -> None:
    """A ring of large pictures without alpha, as JPEG files of few kinds."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i in range(VIEWS):
        name = f"images/{i:03d}.jpg"
        if i < 3:
            small = rng.integers(0, 255, (HEIGHT // 50, WIDTH // 50, 3), dtype=np.uint8)
            Image.fromarray(small).resize((WIDTH, HEIGHT), Image.Resampling.BICUBIC).save(folder / name)
        else:
            (folder / name).write_bytes((folder / f"images/{i % 3:03d}.jpg").read_bytes())
        angle = 2 * np.pi * i / VIEWS
        cos, sin = np.cos(angle), np.sin(angle)
        pose = [[-sin, 0, cos, 4 * cos], [cos, 0, sin, 4 * sin], [0, 1, 0, 0], [0, 0, 0, 1]]
        frames.append({"file_path": name, "transform_matrix": pose})
    content: dict[str, Any] = {"camera_angle_x": 0.7, "frames": frames}
    for split in ("train", "test"):
        (folder / f"transforms_{split}.json").write_text(json.dumps(content))


PEAK = """
import resource, sys
import mi_refgs, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from pathlib import Path
from mi_refgs.data import picture_store
from mi_refgs.data.dataset import read_dataset
from mi_refgs.fitting.objective import Target
from mi_refgs.fitting.targets import Targets
from mi_refgs.methods.method import DataOptions
picture_store.STORE.budget = int(sys.argv[2])
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
data = read_dataset(Path(sys.argv[1]), "train", truth=False)
targets = Targets(data, DataOptions(), int(sys.argv[2]))
for index in range(len(data.views)):
    assert targets[index].camera.width == data.views[0].width
    assert data.views[index].colour(data.background).max() > 0.5
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before, picture_store.STORE.bytes)
"""


def test_memory_is_bounded(tmp_path: Path, rng: np.random.Generator) -> None:
    """24 pictures of 3 Mpx: 216 MB in 8 bits, 864 MB as numbers, 1.4 GB as targets; budgets of 60 MB each."""
    photographs(tmp_path / "data", rng)
    budget = 60_000_000
    command = [sys.executable, "-c", PEAK, str(tmp_path / "data"), str(budget)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    kilobytes, kept = map(int, done.stdout.split())
    assert kept <= budget
    one = 4 * 4 * WIDTH * HEIGHT  # bytes of a picture as numbers, of which a few are made on the way
    assert kilobytes * 1024 < 2 * budget + 8 * one, f"{kilobytes / 1024:.0f} MB"


def test_targets_are_uploaded_at_once_or_when_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Either way they are the same, of the size that is due; those that were used last stay."""
    data = ball(24, 5)
    options = DataOptions(coarse=(CoarsePictures(until=3, block=2),))
    whole, one = Targets(data, options), PIXEL_BYTES * 24 * 24
    made: list[int] = []
    real = View.camera

    def camera(view: View) -> Any:
        made.append(int(view.name))
        return real(view)

    monkeypatch.setattr(View, "camera", camera)
    few = Targets(data, options, 2 * one)
    assert not made
    for index in (0, 1, 0, 2, 0, 1):
        assert few[index].camera.width == 24
        assert np.array_equal(few[index].image[0], whole[index].image[0])
        assert whole.at(3, index).camera.width == 12 and whole.at(4, index) is whole[index]
    assert made == [0, 1, 2, 1]
    lone = Targets(data, options, 1)
    assert lone[3] is lone[3] and lone[4] is not lone[3] and len(lone) == 5


def test_a_view_says_whether_it_has_alpha_without_decoding(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views that are made of arrays stay what they were; views of files are copied undecoded."""
    photographs(tmp_path / "data", rng)
    monkeypatch.setattr(picture_store.STORE, "budget", 0)
    monkeypatch.setattr(PictureFile, "decode", lambda file: pytest.fail("decoded"))
    view = read_dataset(tmp_path / "data", "train", truth=False).views[0]
    assert not view.has_alpha and view.alpha is None and view.changed(near=2.0).near == 2.0
    view = ball().views[0]
    assert view.has_alpha and view.alpha is not None
    other = dataclasses.replace(view, image=view.image * 0.5, alpha=None)
    assert not other.has_alpha and np.array_equal(other.image, view.image * 0.5)


def test_a_loaded_view_decodes_once(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading a data set for its cameras decodes nothing, whatever the budget; a target decodes once."""
    photographs(tmp_path / "data", rng)
    decoded, real = [], PictureFile.decode

    def decode(file: PictureFile) -> np.ndarray:
        decoded.append(file.path.stem)
        return real(file)

    monkeypatch.setattr(PictureFile, "decode", decode)
    view = read_dataset(tmp_path / "data", "train", truth=False, decode=False).views[3]
    assert not decoded
    monkeypatch.setattr(view.__dict__["image"], "store", PictureStore(0))
    loaded = view.load()
    assert decoded == ["003"] and loaded.load() is loaded
    assert np.array_equal(loaded.image, view.image) and loaded.alpha is None
    decoded.clear()
    Target.of(view, np.ones(3))
    assert decoded == ["003"]
    hidden = view.changed(alpha=np.zeros((HEIGHT, WIDTH), np.float32)).load()
    assert hidden.alpha is not None and not hidden.alpha.any()


def test_threads_share_a_store(tmp_path: Path, rng: np.random.Generator) -> None:
    """What is kept is counted, however they meet."""
    for i in range(6):
        write_png(tmp_path / f"{i}.png", rng.random((20, 20, 4)))
    size = 20 * 20 * 4
    store = PictureStore(2 * size)
    pictures = [Picture(PictureFile.find(tmp_path / f"{i}.png", 1), 0.0, store) for i in range(6)]

    def look(first: int) -> None:
        for i in range(40):
            assert pictures[(first + i) % 6].planes()[0].shape == (20, 20, 3)

    threads = [threading.Thread(target=look, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.bytes == sum(kept.nbytes for kept in store._kept.values()) <= 2 * size


def test_two_threads_that_decode_one_picture_count_it_once(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second of them meets what the first has kept meanwhile."""
    write_png(tmp_path / "a.png", rng.random((20, 20, 4)))
    store = PictureStore()
    picture = Picture(PictureFile.find(tmp_path / "a.png", 1), 0.0, store, decode=False)
    real, meet = PictureFile.decode, threading.Barrier(2)

    def decode(file: PictureFile) -> np.ndarray:
        meet.wait(20)
        return real(file)

    monkeypatch.setattr(PictureFile, "decode", decode)
    threads = [threading.Thread(target=picture.planes) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert store.bytes == 20 * 20 * 4
