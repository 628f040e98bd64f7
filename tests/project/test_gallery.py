"""docs/gallery_maker.py: its images, its page, and that existing files are not made again."""

from __future__ import annotations

import importlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.cli import main
from mi_refgs.errors import InputError
from tests.helpers import ROOT
from tests.scenes.tiny import SIZE as PIXELS
from tests.scenes.tiny import train_command, write_method, write_open_data

sys.path.insert(0, str(ROOT / "docs"))
maker: Any = importlib.import_module("gallery_maker")

SIZE, SCENE = 24, "plastic_hollows"
SETTINGS: dict[str, Any] = {
    "views": 4,
    "size": SIZE,
    "set": (
        "iterations=6",
        "surfels.count=80",
        "surfels.max_count=100",
        "light.height=8",
        "mesh.resolution=16",
    ),
    "lights": (ROOT / "scenes" / "lights" / "studio.exr",),
}
TURN, TEST_VIEWS = 4, 4
"""Frames of a turntable, and test views, of the small gallery."""
COMMITTED = ROOT / "docs" / "gallery"
LIMIT = 5_000_000
"""Bytes of the gallery in the repository."""


@pytest.fixture(scope="module")
def few() -> Iterator[None]:
    """Few frames and test views."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(maker, "TURN", TURN)
        patch.setattr(maker, "TEST_VIEWS", TEST_VIEWS)
        patch.setattr(maker, "EDIT_VIEWS", (0, TEST_VIEWS // 2))
        yield


@pytest.fixture(scope="module")
def made(few: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gallery")
    maker.make_gallery(folder / "out", folder / "work", (SCENE,), **SETTINGS)
    return folder


def test_gallery_has_its_pictures(made: Path) -> None:
    folder = made / "out" / SCENE
    with Image.open(folder / "turntable.webp") as turntable:
        assert turntable.n_frames == TURN  # type: ignore[attr-defined]
        assert turntable.size == (2 * maker.SHOWN * SIZE, maker.SHOWN * SIZE)
    for name in ("first", "decomposition", "relit", "edits", "lights", "methods"):
        with Image.open(folder / f"{name}.webp") as picture:
            assert np.asarray(picture.convert("RGB")).std() > 5, name


def test_page_shows_every_picture_and_its_scores(made: Path) -> None:
    page = (made / "out" / "README.md").read_text()
    shown = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)
    assert {made / "out" / name for name in shown} == {*(made / "out" / SCENE).glob("*.webp")}
    scores = json.loads((made / "out" / "gallery.json").read_text())["scenes"][SCENE]
    assert f"| {scores['psnr']:.1f} dB |" in page and f"{scores['relit_psnr']:.1f} dB |" in page


def test_existing_files_are_not_made_again(made: Path) -> None:
    """Only the missing image is rendered; the others keep their times."""
    folder = made / "out" / SCENE
    (folder / "edits.webp").unlink()
    before = {path: path.stat().st_mtime_ns for path in [*folder.iterdir(), *(made / "work").rglob("*.png")]}
    maker.make_gallery(made / "out", made / "work", (SCENE,), **SETTINGS)
    assert (folder / "edits.webp").is_file()
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_images_of_an_earlier_fit_are_made_again(made: Path) -> None:
    record = made / "out" / maker.RECORD
    stored = json.loads(record.read_text())
    record.write_text(json.dumps(stored | {"scenes": {SCENE: stored["scenes"][SCENE] | {"psnr": 0.0}}}))
    before = {path: path.stat().st_mtime_ns for path in (made / "out" / SCENE).iterdir()}
    maker.make_gallery(made / "out", made / "work", (SCENE,), **SETTINGS)
    assert all(path.stat().st_mtime_ns > before[path] for path in before)
    assert json.loads(record.read_text()) == stored


def test_unknown_scenes_and_other_settings_are_refused(made: Path) -> None:
    with pytest.raises(InputError, match="use some of mirror_ring"):
        maker.make_gallery(made / "other", scenes=("nothing",))
    with pytest.raises(InputError, match=r"the gallery was made with .*'size': 24"):
        maker.make_gallery(made / "out", made / "work", (SCENE,), **SETTINGS | {"size": 25})


def test_object_in_a_room_is_added(few: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run without alpha: its images, scores and command."""
    monkeypatch.setattr(maker, "ROOM_VIEWS", (0,))
    monkeypatch.setattr(maker, "TILE", PIXELS)
    data, run, out = write_open_data(tmp_path / "data"), tmp_path / "run", tmp_path / "out"
    opaque = ["surroundings.opacity=0.9", "surroundings.count=60"]
    assert main([*train_command(data, run, write_method(tmp_path)), *opaque]) == 0
    maker.make_gallery(out, tmp_path / "work", (), rooms={"can": run}, **SETTINGS)
    with Image.open(out / "can" / "turntable.webp") as turntable:
        assert turntable.n_frames == TURN  # type: ignore[attr-defined]
    with Image.open(out / "can" / "first.webp") as first:
        assert first.height > PIXELS and np.asarray(first.convert("RGB")).std() > 5
    page = (out / "README.md").read_text()
    scores = json.loads((out / "gallery.json").read_text())["rooms"]["can"]
    assert f"PSNR {scores['psnr']:.1f} dB" in page and "--rooms can runs/can" in page
    with pytest.raises(InputError, match="use some of tabletop"):
        maker.make_gallery(out, scenes=(), rooms={"nothing": run}, **SETTINGS)


def test_turntable_turns_and_keeps_colours(tmp_path: Path) -> None:
    frames = [np.full((16, 16, 3), value) for value in (0.2, 0.5, 0.8)]
    maker.write_turntable(tmp_path / "a.webp", frames, seconds=1.5)
    with Image.open(tmp_path / "a.webp") as animation:
        for i, frame in enumerate(frames):
            animation.seek(i)
            assert abs(np.asarray(animation.convert("RGB")).mean() / 255 - frame.mean()) < 0.02
        assert animation.info["loop"] == 0
    maker.write_still(tmp_path / "b.webp", frames[1])
    with Image.open(tmp_path / "b.webp") as still:
        assert not getattr(still, "is_animated", False)


def test_exhibits_are_scenes_of_the_package() -> None:
    for name in maker.EXHIBITS:
        assert (ROOT / "scenes" / f"{name}.xml").is_file()


@pytest.mark.skipif(not COMMITTED.is_dir(), reason="no gallery is kept here")
def test_gallery_of_the_repository_is_complete_and_small() -> None:
    files = [path for path in COMMITTED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LIMIT
    page = (COMMITTED / "README.md").read_text()
    shown = {COMMITTED / name for name in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)}
    assert shown == {path for path in files if path.suffix == ".webp"}
