"""`refgs gallery`: its pictures, its page, and that what is there is not made again."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mi_refgs.cli import main
from mi_refgs.gallery import EXHIBITS
from mi_refgs.gallery.frames import write_still, write_turntable
from mi_refgs.gallery.make import TURN
from tests.helpers import ROOT

SIZE, SCENE = 24, "plastic_hollows"
SETTINGS = [
    "iterations=6",
    "surfels.count=80",
    "surfels.max_count=100",
    "light.height=8",
    "mesh.resolution=16",
]
COMMITTED = ROOT / "docs" / "gallery"
LIMIT = 5_000_000
"""Bytes of the gallery in the repository."""


def command(out: Path, work: Path, *more: str) -> list[str]:
    options = ["--views", "4", "--size", str(SIZE), "--set", *SETTINGS, *more]
    return ["gallery", "-o", str(out), "--work", str(work), "--scenes", SCENE, *options]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("gallery")
    assert main(command(folder / "out", folder / "work")) == 0
    return folder


def test_gallery_has_its_pictures(made: Path) -> None:
    folder = made / "out" / SCENE
    with Image.open(folder / "turntable.webp") as turntable:
        assert turntable.n_frames == TURN and turntable.size == (2 * SIZE, SIZE)  # type: ignore[attr-defined]
    for name in ("decomposition", "relit", "edits"):
        with Image.open(folder / f"{name}.webp") as picture:
            assert np.asarray(picture.convert("RGB")).std() > 5, name


def test_page_shows_every_picture_and_its_scores(made: Path) -> None:
    page = (made / "out" / "README.md").read_text()
    shown = re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)
    assert {made / "out" / name for name in shown} == {*(made / "out" / SCENE).glob("*.webp")}
    scores = json.loads((made / "out" / "gallery.json").read_text())["scenes"][SCENE]
    assert f"| {scores['psnr']:.1f} dB |" in page and f"{scores['relit_psnr']:.1f} dB |" in page


def test_what_is_there_is_not_made_again(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One picture is missing: only that is rendered, and the others keep their bytes and their times."""
    folder = made / "out" / SCENE
    (folder / "edits.webp").unlink()
    before = {path: path.stat().st_mtime_ns for path in [*folder.iterdir(), *(made / "work").rglob("*.png")]}
    assert main([*command(made / "out", made / "work"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["bytes"] < 1e6
    assert (folder / "edits.webp").is_file()
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_bad_input_is_one_sentence(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gallery", "-o", str(made / "other"), "--scenes", "nothing"]) == 2
    assert "use some of mirror_ring" in capsys.readouterr().err
    assert main([*command(made / "out", made / "work"), "--size", "25"]) == 2
    assert "--size: the gallery was made with" in capsys.readouterr().err


def test_turntable_turns_and_keeps_colours(tmp_path: Path) -> None:
    frames = [np.full((16, 16, 3), value) for value in (0.2, 0.5, 0.8)]
    write_turntable(tmp_path / "a.webp", frames, seconds=1.5)
    with Image.open(tmp_path / "a.webp") as animation:
        for i, frame in enumerate(frames):
            animation.seek(i)
            assert abs(np.asarray(animation.convert("RGB")).mean() / 255 - frame.mean()) < 0.02
        assert animation.info["loop"] == 0
    write_still(tmp_path / "b.webp", frames[1])
    with Image.open(tmp_path / "b.webp") as still:
        assert not getattr(still, "is_animated", False)


def test_exhibits_are_scenes_of_the_package() -> None:
    for name in EXHIBITS:
        assert (ROOT / "scenes" / f"{name}.xml").is_file()


@pytest.mark.skipif(not COMMITTED.is_dir(), reason="no gallery is kept here")
def test_gallery_of_the_repository_is_whole_and_small() -> None:
    files = [path for path in COMMITTED.rglob("*") if path.is_file()]
    assert sum(path.stat().st_size for path in files) <= LIMIT
    page = (COMMITTED / "README.md").read_text()
    shown = {COMMITTED / name for name in re.findall(r"!\[[^\]]*\]\(([^)]*)\)", page)}
    assert shown == {path for path in files if path.suffix == ".webp"}
