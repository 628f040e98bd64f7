"""docs/gallery_maker.py: its images, its page, and that existing files are not made again."""

import importlib
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mi_refgs.errors import InputError
from tests.helpers import ROOT, refused

sys.path.insert(0, str(ROOT / "docs"))
maker: Any = importlib.import_module("gallery_maker")

SIZE, SCENE = 24, "plastic_hollows"
SET = "iterations=6 surfels.count=80 surfels.max_count=100 event.mesh.resolution=16"
SETTINGS: dict[str, Any] = {"views": 4, "size": SIZE, "set": tuple(SET.split())}
SETTINGS["lights"] = (ROOT / "scenes" / "lights" / "studio.exr",)
TURN, TEST_VIEWS = 4, 4  # frames of a turntable, and test views, of the small gallery
COMMITTED = ROOT / "docs" / "gallery"
LIMIT = 5_000_000  # bytes of the gallery in the repository


@pytest.mark.slow
def test_gallery_has_its_pictures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its page shows each of them with the scores; existing files are not made again."""
    for name, few in {"TURN": TURN, "TEST_VIEWS": TEST_VIEWS, "EDIT_VIEWS": (0, TEST_VIEWS // 2)}.items():
        monkeypatch.setattr(maker, name, few)
    out, work = tmp_path / "out", tmp_path / "work"
    maker.make_gallery(out, work, (SCENE,), **SETTINGS)
    folder = out / SCENE
    with Image.open(folder / "turntable.webp") as turntable:
        assert turntable.n_frames == TURN  # type: ignore[attr-defined]
        assert turntable.size == (2 * maker.SHOWN * SIZE, maker.SHOWN * SIZE)
    for name in ("first", "decomposition", "relit", "edits", "lights", "methods"):
        with Image.open(folder / f"{name}.webp") as picture:
            assert np.asarray(picture.convert("RGB")).std() > 5, name
    page = (out / "README.md").read_text()
    shown = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)
    assert {out / name for name in shown} == {*folder.glob("*.webp")}
    scores = json.loads((out / "gallery.json").read_text())["scenes"][SCENE]
    assert f"| {scores['psnr']:.1f} dB |" in page and f"{scores['relit_psnr']:.1f} dB |" in page
    (folder / "edits.webp").unlink()
    before = {path: path.stat().st_mtime_ns for path in [*folder.iterdir(), *work.rglob("*.png")]}
    maker.make_gallery(out, work, (SCENE,), **SETTINGS)
    assert (folder / "edits.webp").is_file()
    assert {path: path.stat().st_mtime_ns for path in before} == before
    with pytest.raises(InputError, match=r"the gallery was made with .*'size': 24"):
        maker.make_gallery(out, work, (SCENE,), **SETTINGS | {"size": 25})


def test_unknown_scenes_are_refused(tmp_path: Path) -> None:
    refused(lambda: maker.make_gallery(tmp_path / "other", scenes=("nothing",)), "use some of mirror_ring")
    assert all((ROOT / "scenes" / f"{name}.xml").is_file() for name in maker.EXHIBITS)


def test_gallery_of_the_repository_is_complete_and_small() -> None:
    files = [path for path in COMMITTED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LIMIT
    page = (COMMITTED / "README.md").read_text()
    shown = {COMMITTED / name for name in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)}
    assert shown == {path for path in files if path.suffix == ".webp"}
